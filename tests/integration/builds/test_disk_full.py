"""A disk that is full stops the build with its name; nothing is lost, and with more room the same command goes on."""

import subprocess
import sys
from pathlib import Path

import psutil
import pytest

from tests.helpers.builds import build, digests, finish, start, write_manifest

RUN = {"deadline_s": 60.0, "shard_size": 8}
NAMES = ["fine", "empty", "fine", "fine", "sad", "fine", "fine", "fell"] * 5


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A manifest, and the hashes of its build on a disk with room."""
    folder = tmp_path_factory.mktemp("room")
    manifest = write_manifest(folder / "images.parquet", NAMES)
    build(manifest, folder / "out", **RUN)
    return manifest, digests(folder / "out")


@pytest.fixture
def small_disk(tmp_path):
    """Mounts a file system of so many kilobytes; mounted again, it has another size and still its files."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = []

    def mount(kilobytes: int) -> Path:
        options = f"size={kilobytes}k" + (",remount" if mounted else "")
        tried = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", options, "tmpfs", str(folder)], capture_output=True, text=True, check=False
        )
        if tried.returncode != 0:
            pytest.skip(f"only root can mount: {tried.stderr.strip()}")
        mounted.append(folder)
        return folder

    yield mount
    if mounted:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.mark.parametrize(
    ("executor", "kilobytes"),
    [
        pytest.param("local", 100, marks=pytest.mark.slow),  # the test below meets a limit by the same code
        pytest.param("local", 400, marks=pytest.mark.slow),
        pytest.param("local", 900, marks=pytest.mark.slow),
        pytest.param("ray", 500, marks=pytest.mark.slow),
    ],
)
def test_a_full_disk_stops_the_build_and_more_room_lets_it_go_on(whole, small_disk, executor, kilobytes):
    manifest, expected = whole
    out = small_disk(kilobytes) / "out"
    for _ in range(2):  # the second time there is no room from the beginning on
        code, errors = finish(start(manifest, out, executor, 2, **RUN))
        assert code != 0
        assert "No space left on device" in errors
        assert "make room" in errors
        assert "run the same command to go on" in " ".join(errors.split())
    small_disk(64_000)
    code, errors = finish(start(manifest, out, executor, 2, **RUN))
    assert code == 0, errors
    assert digests(out) == expected


@pytest.mark.slow  # as the full disk above
@pytest.mark.skipif(sys.platform != "linux", reason="limits of another process are set on Linux alone")
def test_a_limit_on_the_size_of_files_is_met_in_the_same_way(whole, tmp_path):
    manifest, expected = whole
    process = start(manifest, tmp_path / "out", **RUN)
    psutil.Process(process.pid).rlimit(psutil.RLIMIT_FSIZE, (40_000, 40_000))
    code, errors = finish(process)
    assert code != 0
    assert "File too large" in errors
    assert finish(start(manifest, tmp_path / "out", **RUN))[0] == 0
    assert digests(tmp_path / "out") == expected
