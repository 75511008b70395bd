"""Processes of a pool end with their parent."""

import subprocess
import sys
import time

import psutil
import pytest

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
