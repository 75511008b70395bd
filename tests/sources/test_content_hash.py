"""The id of a scene stands for every byte that decoding reads; what cannot be asked is not taken for absent."""

from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler
from pathlib import Path

import pytest

from schemas.config import ObserveConfig
from schemas.identity import content_hash
from schemas.manifest import SceneKind
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import exists, list_file_names
from tableverse_factory.sources.capture import MAX_RECORDED_MESHES
from tableverse_factory.sources.content_hash import hash_entry
from tests.helpers.captures_on_disk import write_capture
from tests.helpers.loopback import serving


def digest(folder: Path) -> str:
    return hash_entry(SceneKind.CAPTURE, str(folder), ObserveConfig())


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    return write_capture(tmp_path / "capture", 1)


def test_a_capture_without_recorded_meshes_keeps_the_id_it_always_had(capture: Path) -> None:
    names = ("color.png", "depth.png", "camera.json")
    plain = content_hash(*(part for name in names for part in (name.encode(), (capture / name).read_bytes())))
    assert digest(capture) == plain
    (capture / "meshes").mkdir()
    assert digest(capture) == plain
    for name in ("notes.txt", "mug.obj", "0.obj", "01.obj"):  # which nobody reads
        (capture / "meshes" / name).write_bytes(b"v 0 0 0\n")
    (capture / "meshes" / "7.obj").mkdir()
    assert digest(capture) == plain


def test_every_recorded_mesh_is_part_of_the_capture(capture: Path) -> None:
    (capture / "meshes").mkdir()
    seen = {digest(capture)}
    for name, data in [("1.obj", b"v 0 0 0\n"), ("1.obj", b"v 9 9 9\n"), ("10.obj", b"v 9 9 9\n"), ("2.obj", b"")]:
        (capture / "meshes" / name).write_bytes(data)
        seen.add(digest(capture))
    assert len(seen) == 5
    (capture / "meshes" / "2.obj").unlink()
    (capture / "elsewhere.obj").write_bytes(b"")
    (capture / "meshes" / "2.obj").symlink_to(capture / "elsewhere.obj")
    assert digest(capture) in seen, "a link is read like the file that it names"
    (capture / "meshes" / "10.obj").rename(capture / "meshes" / "11.obj")
    assert digest(capture) not in seen


@pytest.mark.heavy
def test_more_meshes_than_a_picture_has_objects_are_refused(capture: Path) -> None:
    (capture / "meshes").mkdir()
    for number in range(1, MAX_RECORDED_MESHES + 2):
        (capture / "meshes" / f"{number}.obj").touch()
    with pytest.raises(InputError, match="1025 meshes; at most 1024"):
        digest(capture)


def test_a_folder_that_may_not_be_entered_is_not_an_absent_file(capture: Path, monkeypatch) -> None:
    def refuse(self: object, path: str, **_: object) -> dict[str, object]:
        raise PermissionError(13, "Permission denied", path)

    monkeypatch.setattr("fsspec.implementations.local.LocalFileSystem.info", refuse)  # root may enter any
    with pytest.raises(InputError, match=r"cannot be reached: permission denied$"):
        exists(str(capture / "color.png"))


def test_names_that_cannot_be_are_absent(capture: Path) -> None:
    (capture / "loop").symlink_to(capture / "loop")
    for name in ("x" * 300, "loop", "color.png/below", "nothing"):
        assert not exists(f"{capture}/{name}")
    assert exists(str(capture / "color.png"))
    assert list_file_names(str(capture / "nothing")) == list_file_names(str(capture / "color.png" / "meshes")) == ()


@pytest.fixture
def web() -> Iterator[str]:
    """A server that answers `/<status>` with that status."""

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(int(self.path[1:4]))
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *args: object) -> None:
            pass

    with serving(Handler) as address:
        yield address


def test_a_web_server_that_fails_does_not_say_that_a_file_is_absent(web: str) -> None:
    assert exists(f"{web}/200")
    assert [exists(f"{web}/{status}") for status in (403, 404, 410)] == [False] * 3
    for status in (429, 500, 503):
        with pytest.raises(InputError, match=f"cannot be reached: the server answers {status}$") as told:
            exists(f"{web}/{status}?token=secret")
        assert told.value.reason == "unreachable_uri"
        assert "secret" not in str(told.value)
    with pytest.raises(InputError, match="cannot be reached"):
        exists("http://127.0.0.1:9/color.png")
