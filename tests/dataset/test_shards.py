"""Shards: the same scenes give the same bytes, offsets are true, and what cannot be written is refused before."""

import io
import tarfile

import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.scene import Certificate, ExportedScene
from schemas.tables import OBJECTS
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import atomic_file, write_atomic
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.shards import TarShard, check_exported, tar_sort_key

CERTIFICATE = Certificate(0.001, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (), (), (), True, False)
ids = st.from_regex(r"[A-Za-z0-9][A-Za-z0-9_-]{0,20}", fullmatch=True)


def _scene(scene_id: str, files=(("scene.xml", b"<mujoco/>"),), row=None, objects=()) -> ExportedScene:
    return ExportedScene(scene_id, tuple(files), CERTIFICATE, row or {}, tuple(objects), ())


def _tar(scenes: list[ExportedScene]) -> tuple[bytes, dict[str, tuple[int, int]]]:
    file = io.BytesIO()
    tar = TarShard(file)
    places = {s.scene_id: tar.add(s) for s in sorted(scenes, key=lambda s: tar_sort_key(s.scene_id))}
    tar.close()
    return file.getvalue(), places


@pytest.mark.heavy
@given(names=st.lists(ids, min_size=1, max_size=6, unique=True), data=st.data())
def test_members_are_sorted_offsets_are_true_and_order_does_not_matter(names, data):
    scenes = [
        _scene(name, [("assets/a.obj", data.draw(st.binary(max_size=1500))), ("scene.xml", b"x")]) for name in names
    ]
    written, places = _tar(scenes)
    assert _tar(scenes[::-1])[0] == written
    with tarfile.open(fileobj=io.BytesIO(written)) as tar:
        assert tar.getnames() == sorted(tar.getnames())
        assert {(m.mtime, m.uid, m.gid, m.uname, m.gname, m.mode) for m in tar} == {(0, 0, 0, "", "", 0o644)}
    for scene in scenes:
        offset, size = places[scene.scene_id]
        with tarfile.open(fileobj=io.BytesIO(written[offset : offset + size] + bytes(1024))) as one:
            assert {m.name: one.extractfile(m).read() for m in one} == {
                f"{scene.scene_id}/{name}": content for name, content in scene.files
            }


def test_a_copied_scene_stands_as_if_it_had_been_written_there():
    a, b, c = (_scene(name, [("scene.xml", name.encode() * 300)]) for name in "abc")
    written, places = _tar([a, b, c])
    file = io.BytesIO()
    tar = TarShard(file)
    copied = {name: tar.copy(io.BytesIO(written), *places[name]) for name in "ab"}
    copied["c"] = tar.add(c)
    tar.close()
    assert file.getvalue() == written
    assert copied == places


def test_the_headers_are_ustar():
    written, _ = _tar([_scene("a")])
    assert written[257:265] == b"ustar\x0000"


@pytest.mark.parametrize(
    "name",
    [
        "/etc/passwd",
        "../x",
        "a/../../x",
        "a//b",
        "./a",
        "a\nb",
        "a\x00b",
        "",
        "ü.obj",
        "assets/" + "n" * 101,
        "d/" * 150 + "x",
    ],
)
def test_unsafe_or_unwritable_names_are_refused(name):
    with pytest.raises(BuildError, match=r"no safe name|USTAR"):
        check_exported(_scene("a", [(name, b"")]), "a")


@pytest.mark.parametrize(
    ("scene", "words"),
    [
        (_scene("b"), "not 'a'"),
        (_scene("a", [("b", b""), ("a", b"")]), "sorted"),
        (_scene("a", [("a", b""), ("a", b"")]), "sorted"),
        (_scene("a", row={"surprise": 1}), "surprise"),
        (_scene("a", row={"n_objects": "many"}), "scene table"),
        (_scene("a", row={"n_objects": 2**40}), "scene table"),
        (_scene("a", objects=[{"scene_id": "z", "object_id": "obj_000"}]), "scene_id"),
        (_scene("a", objects=[{"scene_id": "a", "mass_kg": "heavy"}]), "object table"),
    ],
)
def test_what_would_break_a_commit_is_refused_before(scene, words):
    with pytest.raises(BuildError, match=words):
        check_exported(scene, "a")


def test_parquet_bytes_depend_on_the_rows_alone():
    rows = [{"scene_id": "a", "object_id": f"obj_{i:03d}", "mass_kg": i / 7} for i in range(100)]
    data = encode_parquet(build_table(rows, OBJECTS))
    assert data == encode_parquet(build_table(rows, OBJECTS))
    table = pq.read_table(io.BytesIO(data))
    assert table.schema.equals(OBJECTS)
    assert table["mass_kg"].to_pylist() == [i / 7 for i in range(100)]


def test_an_interrupted_write_leaves_the_old_file_and_nothing_else(tmp_path):
    path = tmp_path / "file"
    write_atomic(path, b"old")

    def interrupted():
        with atomic_file(path) as file:
            file.write(b"half of the ne")
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("file", b"old")]


def test_a_place_that_refuses_says_so_and_how_to_go_on(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(BuildError, match=r"cannot write .*file/x.*run the same command to go on"):
        write_atomic(tmp_path / "file" / "x", b"")
