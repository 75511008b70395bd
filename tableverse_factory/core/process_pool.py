"""Process pool whose results come in the order of the items and do not depend on the number of processes."""

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TypeVar

from threadpoolctl import threadpool_limits

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.parent_death import die_with_parent

Item = TypeVar("Item")
Result = TypeVar("Result")

CGROUP_CPU_MAX = Path("/sys/fs/cgroup/cpu.max")


def count_available_cpus() -> int:
    """Count the CPUs that this process may use: its affinity and its cgroup's quota."""
    allowed = len(os.sched_getaffinity(0))
    try:
        quota, period = CGROUP_CPU_MAX.read_text().split()
        return allowed if quota == "max" else max(1, min(allowed, int(quota) // int(period)))
    except (OSError, ValueError):  # there is no such group here, or it says nothing of CPUs
        return allowed


def parallel_map(
    work: Callable[[Item], Result], items: Sequence[Item], jobs: int, doing: str, chunk: int = 1
) -> Iterator[Result]:
    """Yield the result for each item in order, each computed on one thread so that bytes do not depend on `jobs`.

    Other processes must be able to import `work`; `doing` is a predicate for the error: `draws scenes`.
    """
    if jobs <= 1 or len(items) < 2:
        with threadpool_limits(1):
            yield from map(work, items)
        return
    # Forked children would share the threads' locks of libraries that are already at work.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(items)), context, prepare_child) as pool, _translate_death(doing):
        with _defer_interrupt():
            results = pool.map(work, items, chunksize=chunk)
        yield from results


def parallel_stream(
    work: Callable[[Item], Result], items: Iterable[Item], jobs: int, doing: str, ahead: int
) -> Iterator[Result]:
    """Do as `parallel_map` for items without end: each of the processes works up to `ahead` items ahead.

    Without `jobs` the work is done here, item by item; one process already works beside the caller.
    """
    if not jobs:
        with threadpool_limits(1):
            yield from map(work, items)
        return
    rest, context = iter(items), multiprocessing.get_context("spawn")
    pool = ProcessPoolExecutor(jobs, context, prepare_child)
    try:
        with _translate_death(doing):
            with _defer_interrupt():
                results = deque(pool.submit(work, item) for item in islice(rest, jobs * ahead))
            while results:
                yield results.popleft().result()
                results.extend(pool.submit(work, item) for item in islice(rest, 1))
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _translate_death(doing: str) -> Iterator[None]:
    try:
        yield
    except BrokenProcessPool as error:
        raise InputError(
            f"a process that {doing} died: its memory ran out, a scene crashed it, or your program is not a file with "
            "its calls under `if __name__ == '__main__'`, which other processes can import"
        ) from error


def prepare_child() -> None:
    """Limit a child to one thread, and end it with its parent: it would wait for work forever."""
    parent = multiprocessing.parent_process()
    die_with_parent(0 if parent is None or parent.pid is None else parent.pid)
    threadpool_limits(1)


@contextmanager
def _defer_interrupt() -> Iterator[None]:
    """Start children that ignore Ctrl-C, and raise one that comes meanwhile when they have started."""
    interrupts: list[int] = []
    in_main_thread = threading.current_thread() is threading.main_thread()
    # The mask is what children inherit; here a library's thread may still take the signal, so it needs a handler.
    handler = signal.signal(signal.SIGINT, lambda number, _: interrupts.append(number)) if in_main_thread else None
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if in_main_thread:
            signal.signal(signal.SIGINT, signal.SIG_DFL if handler is None else handler)  # None: not set by Python
    if interrupts:
        signal.raise_signal(signal.SIGINT)
