"""Work dealt out to processes of their own: results come in the order of the items, on one core or on many."""

from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from typing import TypeVar

from threadpoolctl import threadpool_limits

from tableverse_factory.errors import InputError

Item = TypeVar("Item")
Result = TypeVar("Result")


def mapped(
    work: Callable[[Item], Result], items: Sequence[Item], jobs: int, doing: str, chunk: int = 1
) -> Iterator[Result]:
    """The result for each item, in their order; each is worked out on one thread, so that all give the same bytes.

    Args:
        work: A function that other processes can import, or a `partial` of one.
        items: What it is called with.
        jobs: Processes; with 1, all is done in this one.
        doing: What a process does, for the error: `draws scenes`.
        chunk: Items that a process is given at a time.

    Raises:
        InputError: if a process died.
    """
    if jobs <= 1 or len(items) < 2:
        with threadpool_limits(1):
            yield from map(work, items)
        return
    # Forked children would share the threads' locks of libraries that are already at work.
    context = get_context("spawn")
    with ProcessPoolExecutor(min(jobs, len(items)), context, threadpool_limits, (1,)) as pool:
        try:
            yield from pool.map(work, items, chunksize=chunk)
        except BrokenProcessPool as error:
            raise InputError(f"a process that {doing} died: its memory ran out, or a scene crashed it") from error
