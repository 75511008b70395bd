"""Untrusted files, by path or fsspec URI: read within bounds, decoded only after their headers were checked."""

import io
import json
import math
import struct
import warnings
import zlib
from collections.abc import Iterator
from typing import IO, Any

import numpy as np
from fsspec.implementations.local import LocalFileSystem
from PIL import Image, UnidentifiedImageError

from schemas.config import ObserveConfig
from tableverse_factory.errors import InputError, StoreError
from tableverse_factory.storage import filesystem_at, shown

BLOCK_BYTES = 1024 * 1024
MAX_JSON_BYTES = 16 * 1024 * 1024
MAX_JSON_DEPTH = 64
PICTURE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")

_DECODE_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    MemoryError,
    OverflowError,
    struct.error,
    zlib.error,
    UnidentifiedImageError,
)


def exists(uri: str) -> bool:
    """Whether a file lies there.

    Raises:
        InputError: `unreachable_uri` if the place cannot be asked.
        StoreError: if an object store does not answer: that says nothing about the file.
    """
    try:
        filesystem, path = filesystem_at(uri)
        return bool(filesystem.isfile(path))
    except StoreError:
        raise
    except (OSError, ValueError, ImportError) as error:
        raise InputError(
            f"{shown(uri)!r} cannot be reached: {type(error).__name__}: {error}", "unreachable_uri"
        ) from error


def read_bytes(uri: str, max_bytes: int, reason: str) -> bytes:
    """The whole file.

    Raises:
        InputError: with `reason` if it is absent or unreadable, `file_too_large` if it is longer than `max_bytes`.
        StoreError: if an object store does not answer: that says nothing about the file.
    """
    try:
        filesystem, path = filesystem_at(uri)
        if isinstance(filesystem, LocalFileSystem) and filesystem.exists(path) and not filesystem.isfile(path):
            raise InputError(f"{shown(uri)!r} is no regular file", reason)  # a pipe would block for ever
        with filesystem.open(path, "rb") as file:
            data = b"".join(_blocks(file, max_bytes + 1))
    except StoreError:
        raise
    except (OSError, ValueError, ImportError) as error:
        raise InputError(f"{shown(uri)!r} cannot be read: {type(error).__name__}: {error}"[:500], reason) from error
    if len(data) > max_bytes:
        raise InputError(f"{shown(uri)!r} is longer than {max_bytes} bytes, the most that is read", "file_too_large")
    return data


def _blocks(file: IO[bytes], most: int) -> Iterator[bytes]:
    """The first `most` bytes, block by block: asking for all at once sets memory for all aside."""
    while most > 0 and (block := file.read(min(most, BLOCK_BYTES))):
        most -= len(block)
        yield block


def parse_json(data: bytes, name: str, reason: str) -> Any:
    """The value in a JSON file; NaN and infinities come through as floats, for the caller to judge.

    Raises:
        InputError: with `reason` if it is no JSON, too long, or nested deeper than `MAX_JSON_DEPTH`.
    """
    if len(data) > MAX_JSON_BYTES:
        raise InputError(f"{name} is {len(data)} bytes; at most {MAX_JSON_BYTES} are parsed", reason)
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name} is no JSON: {type(error).__name__}: {error}"[:500], reason) from error
    if _nesting(data) > MAX_JSON_DEPTH:
        raise InputError(f"{name} is nested deeper than {MAX_JSON_DEPTH} levels", reason)
    return value


def _nesting(data: bytes) -> int:
    """An upper bound of the nesting depth: brackets inside strings count too."""
    codes = np.frombuffer(data, dtype=np.uint8)
    steps = np.isin(codes, (0x5B, 0x7B)).astype(np.int32) - np.isin(codes, (0x5D, 0x7D)).astype(np.int32)
    return int(np.cumsum(steps).max(initial=0))


def open_picture(data: bytes, name: str, bounds: ObserveConfig, reason: str) -> Image.Image:
    """The picture with only its header read, its size within bounds.

    Raises:
        InputError: with `reason` if it is no picture, `picture_too_large` if it has too many pixels.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # our own bound decides, below
            image = Image.open(io.BytesIO(data), formats=PICTURE_FORMATS)
    except Image.DecompressionBombError as error:
        raise InputError(f"{name} is too large: {error}", "picture_too_large") from error
    except UnidentifiedImageError as error:  # its own text holds a memory address: another one in every run
        raise InputError(f"{name} is no picture: give one of {', '.join(PICTURE_FORMATS)}", reason) from error
    except _DECODE_ERRORS as error:
        raise InputError(f"{name} is no picture: {type(error).__name__}: {error}"[:500], reason) from error
    width, height = image.size
    if width * height > bounds.max_pixels:
        raise InputError(
            f"{name} is {width} x {height} = {width * height} pixels; at most {bounds.max_pixels} "
            "(observe.max_pixels) are decoded",
            "picture_too_large",
        )
    if width < 1 or height < 1:
        raise InputError(f"{name} is {width} x {height} pixels: it has no content", reason)
    return image


def decoded(image: Image.Image, name: str, mode: str | None, reason: str) -> np.ndarray[Any, Any]:
    """The pixels, converted to `mode` where one is given.

    Raises:
        InputError: with `reason` if the file is truncated or broken.
    """
    try:
        image.load()
        return np.array(image.convert(mode) if mode is not None else image)
    except _DECODE_ERRORS as error:
        raise InputError(f"{name} does not decode: {type(error).__name__}: {error}"[:500], reason) from error


def finite_number(value: Any) -> float | None:
    """`value` as a float if it is a finite JSON number, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
