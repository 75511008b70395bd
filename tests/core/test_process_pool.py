"""Processes of a pool work in order, and end with their parent."""

import math
import os
import subprocess
import sys
import time
from itertools import count, islice

import psutil
import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.process_pool import parallel_stream

PARENT = """
import time
from tableverse_factory.core.process_pool import parallel_map
print(*parallel_map(time.sleep, [0, 60, 60], 2, "sleeps"))
"""


@pytest.mark.heavy
def test_no_process_of_a_killed_parent_waits_for_work_forever():
    with subprocess.Popen([sys.executable, "-c", PARENT], stderr=subprocess.DEVNULL) as process:
        parent, children = psutil.Process(process.pid), []
        while len(children) < 3:  # two of the pool, and the tracker of their semaphores
            time.sleep(0.05)
            children = parent.children(recursive=True)
        process.kill()
    gone, alive = psutil.wait_procs(children, timeout=20)
    assert len(gone) == len(children), alive


def test_a_stream_without_end_is_worked_a_little_ahead_and_comes_in_order():
    taken = []

    def count_up():
        for k in count():
            taken.append(k)
            yield k

    assert list(islice(parallel_stream(math.sqrt, count_up(), 0, "counts", 3), 3)) == [math.sqrt(k) for k in range(3)]
    assert len(taken) == 3


@pytest.mark.heavy
def test_processes_give_the_stream_of_one_and_end_with_it():
    taken = []

    def count_up():
        for k in count():
            taken.append(k)
            yield k

    before = {child.pid for child in psutil.Process().children()}
    stream = parallel_stream(math.sqrt, count_up(), 2, "counts", 3)
    assert [next(stream) for _ in range(20)] == [math.sqrt(k) for k in range(20)]
    assert len(taken) == 20 - 1 + 2 * 3
    workers = [child for child in psutil.Process().children() if child.pid not in before]
    assert len([child for child in workers if "spawn_main" in " ".join(child.cmdline())]) == 2
    stream.close()
    assert not any("spawn_main" in " ".join(child.cmdline()) for child in workers if child.is_running())
    assert list(parallel_stream(math.sqrt, [1, 4], 2, "counts", 3)) == [1, 2], "a stream may end"


@pytest.mark.heavy
def test_a_process_of_a_stream_that_dies_ends_it_in_one_line():
    with pytest.raises(InputError, match="a process that counts died"):
        list(parallel_stream(os._exit, [3, 3], 1, "counts", 1))
