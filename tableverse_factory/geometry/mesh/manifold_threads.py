"""manifold3d on one thread: for solids of objects its threads cost up to twice the CPU time and save little."""

import os
from functools import cache

import manifold3d


@cache
def limit_manifold_threads() -> None:
    """Make manifold3d work on one thread in this process and its forks; to be called before the first solid.

    Its thread pool, oneTBB, has no setting within reach of Python. It counts the processors that the main thread may
    use, once, at its first operation.
    """
    if not hasattr(os, "sched_setaffinity"):  # not Linux
        return
    process = os.getpid()
    allowed = os.sched_getaffinity(process)
    os.sched_setaffinity(process, {min(allowed)})
    try:
        cube = manifold3d.Manifold.cube()
        (cube - cube.translate([0.5, 0.0, 0.0])).volume()
    finally:
        os.sched_setaffinity(process, allowed)
