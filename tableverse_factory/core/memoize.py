"""In-process memoization of pure functions by the content of their arguments.

The stages of a scene ask the same of the same shapes, and each gets its own copies of them: the answer is found by the
bytes of the arrays. What a function gives is shared by its callers: records, whose arrays cannot be written. What is
kept is bounded by its size, as answers differ in it by orders of magnitude.
"""

import sys
from collections import OrderedDict
from collections.abc import Callable, Iterator
from dataclasses import fields, is_dataclass
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import numpy as np

from schemas.identity import content_hash

P = ParamSpec("P")
R = TypeVar("R")

_CACHES: list[OrderedDict[str, Any]] = []


def memoize_by_content(most_bytes: int) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Memoize a pure function of records, arrays and scalars in this process.

    Args:
        most_bytes: That all answers together hold; a larger one is not remembered.
    """

    def remembering(function: Callable[P, R]) -> Callable[P, R]:
        answers: OrderedDict[str, tuple[R, int]] = OrderedDict()  # each with its size
        _CACHES.append(answers)

        @wraps(function)
        def answered(*args: P.args, **kwargs: P.kwargs) -> R:
            key = content_hash(*_content_parts((args, sorted(kwargs.items()))))
            if key in answers:
                answers.move_to_end(key)
                return answers[key][0]
            answer = function(*args, **kwargs)
            size = measure_bytes(answer)
            if size <= most_bytes:
                answers[key] = answer, size
                while sum(held for _, held in answers.values()) > most_bytes:
                    answers.popitem(last=False)
            return answer

        return answered

    return remembering


def clear_caches() -> None:
    """Clear the caches of all memoized functions of this process."""
    for answers in _CACHES:
        answers.clear()


def measure_bytes(value: Any) -> int:
    """Measure the memory that a value keeps alive; for a view, that of its base [bytes]."""
    size = sys.getsizeof(value)
    if isinstance(value, np.ndarray):
        while isinstance(value.base, np.ndarray):
            value = value.base
        return max(size, int(value.nbytes))
    if isinstance(value, tuple | list):
        return size + sum(measure_bytes(item) for item in value)
    if is_dataclass(value):
        return size + sum(measure_bytes(getattr(value, field.name)) for field in fields(value))
    return size


def _content_parts(value: Any) -> Iterator[bytes]:
    """Yield the bytes that define a value; lengths and types keep values of other shapes apart."""
    if isinstance(value, np.ndarray):
        yield f"{value.dtype.str}{value.shape}".encode()
        yield value.tobytes()
    elif isinstance(value, tuple | list):
        yield f"{len(value)}".encode()
        for item in value:
            yield from _content_parts(item)
    elif is_dataclass(value):
        yield type(value).__name__.encode()
        for field in fields(value):
            yield from _content_parts(getattr(value, field.name))
    elif value is None or isinstance(value, bool | int | float | str | bytes):
        yield repr(value).encode()
    else:
        raise TypeError(f"{type(value).__name__} has no content that could be known again")
