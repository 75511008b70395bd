"""Files of plain arrays that trainings read."""

import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np

from tableverse_factory.core.errors import InputError


def write_arrays(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write a compressed .npz file, at once or not at all; equal arrays give equal bytes."""
    partial = path.with_suffix(".partial")
    with partial.open("wb") as file:
        np.savez_compressed(file, **arrays)
    partial.rename(path)


@contextmanager
def refuse_damaged(path: Path, what: str, remedy: str) -> Iterator[None]:
    """Raise an `InputError` if what is read from a file meanwhile is not `what`; `remedy` is what to do then."""
    try:
        yield
    except (OSError, ValueError, KeyError, EOFError, TypeError, MemoryError, BadZipFile, zlib.error) as error:
        said = " ".join(f"{type(error).__name__}: {error}".split())[:300]
        raise InputError(f"{path} is not {what} ({said}): {remedy}") from error


def check_arrays(held: object, wanted: Mapping[str, tuple[tuple[int, ...], Any]]) -> None:
    """Check shape and type of arrays, by the names of their attributes; ValueError names the first that is wrong."""
    for name, (shape, kind) in wanted.items():
        array = getattr(held, name)
        if array.shape != shape or array.dtype != kind:
            raise ValueError(f"{name} is {array.dtype} of shape {array.shape}, not {np.dtype(kind)} of {shape}")
