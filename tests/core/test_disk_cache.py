"""A cache gives back what was put into it, or nothing, and keeps no half of it."""

import os
import subprocess
import sys
import time

import pytest

from schemas.identity import content_hash
from tableverse_factory.core.disk_cache import DiskCache

KEY = content_hash(b"key")
KILLED = """
import os, signal, sys
from pathlib import Path
from tableverse_factory.core.disk_cache import DiskCache
os.fsync = lambda descriptor: os.kill(os.getpid(), signal.SIGKILL)
DiskCache(Path(sys.argv[1]), ".bin", durable=True).put(sys.argv[2], b"half")
"""


def test_what_was_put_is_got_and_damage_is_nothing(tmp_path):
    cache = DiskCache(tmp_path, ".bin")
    assert cache.get(KEY) is None
    cache.put(KEY, b"payload")
    assert cache.get(KEY) == b"payload"
    (path,) = tmp_path.rglob("*.bin")
    path.write_bytes(path.read_bytes()[:-1])
    assert cache.get(KEY) is None


def test_the_rest_of_a_killed_writer_is_removed_after_a_day_and_no_sooner(tmp_path):
    for _ in range(2):
        killed = subprocess.run([sys.executable, "-c", KILLED, str(tmp_path), KEY])
        assert killed.returncode == -9
    old, new = tmp_path.rglob("*.part")
    yesterday = time.time() - 90_000
    os.utime(old, (yesterday, yesterday))
    DiskCache(tmp_path, ".bin").put(KEY, b"whole")
    assert list(tmp_path.rglob("*.part")) == [new]
    assert DiskCache(tmp_path, ".bin").get(KEY) == b"whole"


def test_what_cannot_be_written_leaves_nothing(tmp_path):
    with pytest.raises(TypeError):
        DiskCache(tmp_path, ".bin").put(KEY, "no bytes")
    assert not [path for path in tmp_path.rglob("*") if path.is_file()]
