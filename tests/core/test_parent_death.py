"""A process ends with its parent, and at once if it comes too late for that."""

import os
import subprocess
import sys

import psutil

SLEEP = "from tableverse_factory.core.parent_death import die_with_parent; import sys, time; die_with_parent({parent})"
PARENT = f"""
import os, subprocess, sys
code = {SLEEP!r}.format(parent=os.getpid()) + "; print('ready', flush=True); time.sleep(60)"
subprocess.run([sys.executable, "-c", code])
"""


def test_a_process_ends_with_its_killed_parent():
    with subprocess.Popen([sys.executable, "-c", PARENT], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout.readline() == "ready\n"
        children = psutil.Process(parent.pid).children()
        parent.kill()
    gone, alive = psutil.wait_procs(children, timeout=20)
    assert (len(gone), alive) == (1, [])


def test_a_process_whose_parent_is_another_one_ends_at_once():
    code = SLEEP.format(parent=os.getppid()) + "; time.sleep(60)"
    assert subprocess.run([sys.executable, "-c", code], timeout=30).returncode == 1
