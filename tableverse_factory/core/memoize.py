"""In-process memoization of pure functions by the content of their arguments.

Callers share a result, whose arrays must be read-only. Caches are bounded in bytes, as results differ in size by orders
of magnitude.
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


def memoize_by_content(max_bytes: int) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Memoize a pure function of records, arrays and scalars, keeping at most `max_bytes` of results."""

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        cache: OrderedDict[str, tuple[R, int]] = OrderedDict()  # each with its size
        _CACHES.append(cache)

        @wraps(function)
        def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
            key = content_hash(*_content_parts((args, sorted(kwargs.items()))))
            if key in cache:
                cache.move_to_end(key)
                return cache[key][0]
            result = function(*args, **kwargs)
            size = measure_bytes(result)
            if size <= max_bytes:
                cache[key] = result, size
                while sum(held for _, held in cache.values()) > max_bytes:
                    cache.popitem(last=False)
            return result

        return wrapper

    return decorate


def clear_caches() -> None:
    """Clear the caches of all memoized functions of this process."""
    for cache in _CACHES:
        cache.clear()


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
        raise TypeError(f"{type(value).__name__} cannot be hashed by content")
