"""Items in processes of their own: what befalls one never touches another."""

import ctypes
import os
import subprocess
import sys
import time

import psutil
import pytest

from tableverse_factory.core.errors import (
    AnswerInvalidError,
    ConfigError,
    GeometryError,
    InputError,
    ModelAccessError,
    ModelError,
    StoreError,
)
from tableverse_factory.stages.trajectories.fork_pool import ItemFailure, map_in_fork
from tests.helpers.builds import wait_until

pytestmark = pytest.mark.heavy

MEMORY_MB = 4000


def test_answers_come_in_order_whatever_befalls_items_between():
    def work(item: int) -> bytes:
        if item == 1:
            ctypes.string_at(0)
        if item == 3:
            raise ValueError("no such\nthing")
        if item == 4:
            time.sleep(60)
        if item == 6:
            os._exit(7)
        return b"x" * (item * 300_000)

    answers = map_in_fork(work, 8, deadline_s=1.0, memory_mb=MEMORY_MB)
    assert [len(answer) for answer in answers if isinstance(answer, bytes)] == [0, 600_000, 1_500_000, 2_100_000]
    lost = {item: answer for item, answer in enumerate(answers) if isinstance(answer, ItemFailure)}
    assert {item: answer.kind for item, answer in lost.items()} == {
        1: "crash",
        3: "exception",
        4: "timeout",
        6: "crash",
    }
    assert "SIGSEGV" in lost[1].detail
    assert lost[3].detail == "ValueError: no such thing"
    assert "1 s" in lost[4].detail
    assert lost[6].detail.endswith("ended with 7")


def test_memory_is_bounded():
    def work(item: int) -> bytes:
        hoard = [b"\1" * 20_000_000 for _ in range(100 if item == 0 else 1)]
        time.sleep(0.5)
        return str(len(hoard)).encode()

    limit = psutil.Process().memory_info().rss / 1e6 + 500
    first, second = map_in_fork(work, 2, deadline_s=30.0, memory_mb=limit)
    assert isinstance(first, ItemFailure)
    assert first.kind == "out_of_memory"
    assert second == b"1"


def list_children() -> set[psutil.Process]:
    return set(psutil.Process().children())


def test_what_the_parent_holds_stays_untouched_and_nobody_is_left():
    held, before = [0], list_children()

    def work(item: int) -> bytes:
        held[0] += 1
        if item == 2:
            os.abort()
        return bytes([held[0]])

    answers = map_in_fork(work, 4, deadline_s=10.0, memory_mb=MEMORY_MB)
    assert [answer if isinstance(answer, bytes) else answer.kind for answer in answers] == [
        b"\1", b"\2", "crash", b"\1",
    ]  # fmt: skip
    assert held == [0]
    assert list_children() <= before  # children of other tests may end meanwhile


def test_nothing_to_do():
    assert map_in_fork(lambda item: b"", 0, 1.0, MEMORY_MB) == ()


@pytest.mark.parametrize("kind", [ConfigError, ModelAccessError, ModelError, StoreError])
def test_errors_that_no_item_is_to_blame_for_are_raised_as_what_they_are(kind):
    def work(item: int) -> bytes:
        if item == 1:
            raise kind("the server\nis dead: ☃")
        return b""

    before = list_children()
    with pytest.raises(kind) as raised:
        map_in_fork(work, 3, 10.0, MEMORY_MB)
    assert type(raised.value) is kind
    assert str(raised.value) == "the server is dead: ☃"
    assert list_children() <= before


@pytest.mark.parametrize("kind", [AnswerInvalidError, GeometryError, InputError, KeyError])
def test_errors_of_an_item_stay_its_own(kind):
    def work(item: int) -> bytes:
        if item == 1:
            raise kind("bad")
        return b"x"

    first, second, third = map_in_fork(work, 3, 10.0, MEMORY_MB)
    assert (first, third) == (b"x", b"x")
    assert isinstance(second, ItemFailure)
    assert (second.kind, second.detail.partition(":")[0]) == ("exception", kind.__name__)


def test_no_item_is_begun_for_a_parent_that_was_killed_while_it_forked(tmp_path):
    script = f"""
import os, time
from pathlib import Path
from tableverse_factory.stages.trajectories.fork_pool import map_in_fork
def wait_for_its_death():
    Path({str(tmp_path / "forked")!r}).write_text(str(os.getpid()))
    while os.getppid() == parent:
        time.sleep(0.01)
parent = os.getpid()
os.register_at_fork(after_in_child=wait_for_its_death)
map_in_fork(lambda item: Path({str(tmp_path / "begun")!r}).touch() or b"", 1, 30.0, {MEMORY_MB})
"""
    forked = tmp_path / "forked"
    with subprocess.Popen([sys.executable, "-c", script]) as parent:
        wait_until(lambda: parent.poll() is not None or (forked.exists() and forked.read_text()))
        assert parent.poll() is None
        child = psutil.Process(int(forked.read_text()))
        parent.kill()
    assert psutil.wait_procs([child], timeout=20)[1] == []
    assert not (tmp_path / "begun").exists()
