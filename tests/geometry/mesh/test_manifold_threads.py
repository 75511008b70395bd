"""manifold3d starts no threads of its own."""

import subprocess
import sys

import pytest

PROGRAM = """
import os
import tableverse_factory.geometry.mesh.{module}
import manifold3d
allowed, threads = os.sched_getaffinity(0), len(os.listdir("/proc/self/task"))
ball = manifold3d.Manifold.sphere(1.0, 100)
(ball - ball.translate([0.5, 0.0, 0.0])).volume()
print(len(os.listdir("/proc/self/task")) - threads, os.sched_getaffinity(0) == allowed, len(allowed))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="threads are counted in /proc")
@pytest.mark.parametrize("module", ["repair", pytest.param("hulls", marks=pytest.mark.slow)])
def test_solids_are_cut_without_further_threads(module: str) -> None:
    """On all processors, and these stay allowed."""
    command = [sys.executable, "-c", PROGRAM.format(module=module)]
    printed = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert printed.split()[:2] == ["0", "True"]
