"""A signal ends the build in time, even where the main thread never comes back to look at it."""

import signal
import subprocess
import sys
import time

import pytest

from tests.helpers.builds import crowd
from workers.driver.signals import HARD_END_S, StoppedError, StopSignals

pytestmark = pytest.mark.heavy

DEAF = """
import hashlib, time
from workers.driver import signals
from workers.driver.signals import StopSignals
signals.HARD_END_S = {hard_end_s}
with StopSignals("all is kept"):
    print("ready", flush=True)
    time.sleep(600) if {asleep} else hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)
"""


def _deaf(asleep: bool, hard_end_s: float = HARD_END_S) -> subprocess.Popen[str]:
    """A process whose main thread sleeps, or computes in native code that lets no Python handler run."""
    process = subprocess.Popen(
        [sys.executable, "-c", DEAF.format(asleep=asleep, hard_end_s=hard_end_s)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout.readline() == "ready\n"
    return process


def test_a_deaf_main_thread_is_ended_within_three_seconds():
    process, asked = _deaf(asleep=True), time.monotonic()
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=60)
    assert 2.0 < time.monotonic() - asked < 3.0 * crowd()
    assert process.returncode == 143
    assert errors == "all is kept\n"


@pytest.mark.parametrize("asleep", [True, False])
def test_a_second_signal_ends_at_once(asleep):
    process = _deaf(asleep, hard_end_s=600.0)
    process.send_signal(signal.SIGINT)
    time.sleep(0.3)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=60)
    assert process.returncode == 130


def test_a_signal_is_seen_at_the_next_look_and_handlers_come_back_afterwards():
    before = signal.getsignal(signal.SIGTERM)
    with StopSignals("unused") as signals:
        signals.check()
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(StoppedError) as stopped:
            signals.check()
    assert stopped.value.number == signal.SIGTERM
    assert signal.getsignal(signal.SIGTERM) is before
