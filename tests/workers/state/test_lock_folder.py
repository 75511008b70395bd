"""Locks of two commands on one folder that end and begin at the same time."""

import fcntl
import os
import platform
import re
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from tableverse_factory.core.errors import BuildError
from workers.state import lock as lock_module
from workers.state.lock import FileLock, describe_writer
from workers.state.lock_owner import LockOwner, encode_owner


def test_a_lock_ends_although_another_command_writes_into_its_folder(tmp_path, monkeypatch):
    folder = tmp_path / ".work"
    lock = FileLock(folder / "lock")
    unlink = type(tmp_path).unlink

    def unlink_and_go_on(path, *arguments):
        unlink(path, *arguments)
        (folder / "other").touch()  # what the next command does before the folder is removed

    with lock:
        monkeypatch.setattr(type(tmp_path), "unlink", unlink_and_go_on)
    assert (folder / "other").exists()
    monkeypatch.undo()
    with FileLock(folder / "lock"):
        pass


def test_a_look_at_the_lock_refuses_no_build(tmp_path, monkeypatch):
    path = tmp_path / "out" / ".work" / "lock"
    path.parent.mkdir(parents=True)
    path.write_bytes(encode_owner(LockOwner(4711, "gone")))
    looking = os.open(path, os.O_RDWR)
    fcntl.flock(looking, fcntl.LOCK_SH)  # as `describe_writer` does, until the build waits for it
    waiting = SimpleNamespace(monotonic=time.monotonic, sleep=lambda _: os.close(looking))
    monkeypatch.setattr(lock_module, "time", waiting)
    with FileLock(path):
        assert describe_writer(path) == f"process {os.getpid()} on {platform.node()}"


def test_a_second_build_is_refused_and_told_what_to_do(tmp_path):
    path = tmp_path / "out" / ".work" / "lock"
    words = f"{tmp_path / 'out'} is being written by process {os.getpid()} on {platform.node()}: wait for it"
    with FileLock(path), pytest.raises(BuildError, match=re.escape(words)):
        FileLock(path).__enter__()
    assert describe_writer(path) is None


def test_a_lock_that_cannot_be_written_is_not_held(tmp_path):
    """The limit on file size stands for the disk, in a process of its own."""
    script = f"""
import resource, signal
from pathlib import Path
from tableverse_factory.core.errors import BuildError
from workers.state.lock import FileLock
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
_, most = resource.getrlimit(resource.RLIMIT_FSIZE)
resource.setrlimit(resource.RLIMIT_FSIZE, (0, most))
path = Path({str(tmp_path / "lock")!r})
try:
    FileLock(path).__enter__()
except BuildError as error:
    print(error)
resource.setrlimit(resource.RLIMIT_FSIZE, (most, most))
with FileLock(path):
    print("held")
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert "cannot write" in ran.stdout
    assert ran.stdout.endswith("held\n"), ran.stderr


@pytest.mark.heavy
def test_commands_that_end_and_begin_at_once_are_refused_by_name_alone(tmp_path):
    script = f"""
import time
from pathlib import Path
from tableverse_factory.core.errors import BuildError
from workers.state.lock import FileLock
until = time.monotonic() + 2.0
while time.monotonic() < until:
    try:
        with FileLock(Path({str(tmp_path)!r}) / ".work" / "lock"):
            pass
    except BuildError as error:
        if "is being written by" not in str(error):
            raise
"""
    commands = [subprocess.Popen([sys.executable, "-c", script], stderr=subprocess.PIPE, text=True) for _ in range(4)]
    assert [command.communicate()[1] for command in commands] == [""] * 4


@pytest.mark.parametrize("place", ["disk", "disk/out", "disk/out/.work"])
@pytest.mark.parametrize("way", [Path.touch, lambda path: path.symlink_to("gone")])
def test_a_folder_that_cannot_be_made_is_a_clear_error(tmp_path, way, place):
    """As on a disk that is not mounted."""
    (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
    way(tmp_path / place)
    with pytest.raises(BuildError, match=r"cannot write .*(File exists|Not a directory)"):
        FileLock(tmp_path / "disk/out/.work/lock").__enter__()
