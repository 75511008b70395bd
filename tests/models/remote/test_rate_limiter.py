"""The pace of questions over all threads and processes of one machine, and what is left of it after kill -9."""

import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from schemas.config import AskingConfig
from tableverse_factory.core.errors import ModelAccessError, ModelError
from tableverse_factory.models.remote.rate_limiter import RateLimiter

HOLD = """
import sys, time
from pathlib import Path
from schemas.config import AskingConfig
from tableverse_factory.models.remote.rate_limiter import RateLimiter
with RateLimiter(Path(sys.argv[1]), AskingConfig(max_parallel=1)).turn(time.monotonic() + 60):
    print("here", flush=True)
    time.sleep(60)
"""


def soon(seconds=5.0) -> float:
    return time.monotonic() + seconds


@pytest.mark.heavy
def test_no_more_questions_than_allowed_are_under_way(tmp_path):
    under_way, most = [], []

    def ask(number):
        with RateLimiter(tmp_path, AskingConfig(max_parallel=2)).turn(soon()):
            under_way.append(number)
            most.append(len(under_way))
            time.sleep(0.05)
            under_way.remove(number)

    with ThreadPoolExecutor(6) as threads:
        list(threads.map(ask, range(6)))
    assert max(most) == 2


@pytest.mark.heavy
def test_another_process_counts_and_one_that_is_killed_does_not(tmp_path):
    holder = subprocess.Popen([sys.executable, "-c", HOLD, str(tmp_path)], stdout=subprocess.PIPE, text=True)
    assert holder.stdout.readline() == "here\n"
    mine = RateLimiter(tmp_path, AskingConfig(max_parallel=1))
    began = time.monotonic()
    with pytest.raises(ModelError, match=r"no turn to ask came in time: asking.max_parallel is 1 on this"):
        mine.turn(began + 0.3).__enter__()
    assert time.monotonic() - began < 0.5
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    holder.stdout.close()
    with mine.turn(soon(1.0)):
        pass


@pytest.mark.heavy
def test_questions_begin_evenly_within_the_minute(tmp_path):
    begun = []

    def ask(_):
        with RateLimiter(tmp_path, AskingConfig(per_minute=600)).turn(soon(20.0)):
            begun.append(time.monotonic())

    started = time.monotonic()
    with ThreadPoolExecutor(4) as threads:
        list(threads.map(ask, range(6)))
    early = [at for place, at in enumerate(sorted(begun)) if at < started + 0.1 * place]
    assert not early  # late they may be: threads wait for their turn at the processor, too


def test_who_cannot_have_a_turn_in_time_is_told_at_once_and_takes_none(tmp_path):
    slow = RateLimiter(tmp_path, AskingConfig(per_minute=1))
    with slow.turn(soon()):
        pass
    for _ in range(3):
        began = time.monotonic()
        with pytest.raises(ModelError, match=r"asking.per_minute 1 on this machine"):
            slow.turn(began + 20.0).__enter__()
        assert time.monotonic() - began < 1.0
    with RateLimiter(tmp_path, AskingConfig()).turn(soon(0.5)):  # another build, which has no limit
        pass


def test_a_file_that_is_damaged_or_a_folder_that_is_none(tmp_path):
    pace = RateLimiter(tmp_path, AskingConfig(per_minute=600))
    with pace.turn(soon()):
        pass
    (next_file,) = tmp_path.glob("asking/*/next")
    next_file.write_bytes(b"?")
    with pace.turn(soon()):
        pass
    (tmp_path / "file").write_text("")
    with pytest.raises(ModelAccessError, match=r"turns to ask cannot be kept in .*Not a directory"):
        RateLimiter(tmp_path / "file", AskingConfig()).turn(soon()).__enter__()


def test_what_goes_wrong_while_it_is_held_is_told_as_it_is_and_gives_the_turn_back(tmp_path):
    pace = RateLimiter(tmp_path, AskingConfig(max_parallel=1))
    with pytest.raises(OSError, match="the question's own"), pace.turn(soon()):
        raise OSError("the question's own")
    with pace.turn(soon(0.2)):
        pass


def test_who_waits_longest_comes_first(tmp_path):
    turns = []

    def ask(number):
        with RateLimiter(tmp_path, AskingConfig(max_parallel=1)).turn(soon(20.0)):
            turns.append(number)

    def waiting():
        return len(list(tmp_path.glob("asking/*/place-*")))

    with ThreadPoolExecutor(4) as threads, RateLimiter(tmp_path, AskingConfig(max_parallel=1)).turn(soon()):
        for number in range(4):
            threads.submit(ask, number)
            until = soon(10.0)
            while waiting() < number + 2 and time.monotonic() < until:
                time.sleep(0.01)
    assert turns == [0, 1, 2, 3]
