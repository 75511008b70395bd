"""Calls with a timeout."""

import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

T = TypeVar("T")


def call_with_timeout(seconds: float, question: Callable[[], T], late: Exception) -> T:
    """Call `question` in another thread and wait for its result at most `seconds` [s]; then raise `late`.

    What waits in a library without end, or in its native part, ends neither by itself nor on Ctrl-C.
    """
    answer: Future[T] = Future()

    def run() -> None:
        try:
            answer.set_result(question())
        except BaseException as error:  # noqa: BLE001 raised again where it is waited for
            answer.set_exception(error)

    threading.Thread(target=run, daemon=True).start()
    try:
        return answer.result(seconds)
    except TimeoutError:
        if answer.done():
            raise
        raise late from None
