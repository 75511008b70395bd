"""Untrusted files, by path or fsspec URI: read within bounds, and decoded only after their headers were checked."""

import errno
import io
import json
import math
import re
import struct
import warnings
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import IO, Any

import fsspec
import numpy as np
from fsspec.implementations.local import LocalFileSystem
from PIL import Image, UnidentifiedImageError

from schemas.config import ObserveConfig
from tableverse_factory.core.errors import InputError, StoreError
from tableverse_factory.core.storage.files import redact_uri, resolve_filesystem
from tableverse_factory.core.text import describe_error

BLOCK_BYTES = 1024 * 1024
MAX_JSON_BYTES = 16 * 1024 * 1024
MAX_JSON_DEPTH = 64
_HTTP_SCHEMES = ("http://", "https://")
_ABSENT_STATUSES = (403, 410)  # Besides 404: public buckets that may not be listed answer 403 for missing files
_BAD_NAME_ERRNOS = (errno.ENAMETOOLONG, errno.ELOOP)  # Errors of names that cannot exist on a disk
IMAGE_FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TIFF")  # Formats that are decoded; the last two serve textures alone
LARGE_IMAGE_BOUNDS = ObserveConfig(max_pixels=100_000_000)  # Bounds on texture maps: 8K by 8K and a little more
_PIXELS = re.compile(r"\((\d+) pixels\)")  # in Pillow's words
_DECODE_ERRORS = (OSError, SyntaxError, ValueError, EOFError, MemoryError, OverflowError, struct.error, zlib.error)


def find_type(filesystem: fsspec.AbstractFileSystem, path: str) -> str:
    """Find what lies at a path: `file`, `directory`, or another type of the file system; empty where there is nothing.

    fsspec's own `isfile` and `exists` say no to whatever goes wrong; here only what is absent is absent.
    """
    try:
        with _translate_errors():
            if path.startswith(_HTTP_SCHEMES):
                return "file" if filesystem.exists(path, strict=True) else ""
            return str(filesystem.info(path)["type"])
    except (FileNotFoundError, NotADirectoryError):
        return ""
    except OSError as error:
        if error.errno in _BAD_NAME_ERRNOS or getattr(error.__cause__, "status", 0) in _ABSENT_STATUSES:
            return ""
        raise


def exists(uri: str) -> bool:
    """Check whether a file exists; a place that does not answer raises, as it says nothing about the file."""
    try:
        filesystem, path = resolve_filesystem(uri)
        return find_type(filesystem, path) == "file"
    except StoreError:
        raise
    except (OSError, ValueError, ImportError) as error:
        raise _unreachable_error(uri, error) from error


def list_file_names(folder_uri: str) -> tuple[str, ...]:
    """List the names of the files in a folder, sorted; none for a missing folder or over HTTP, without listings."""
    try:
        filesystem, folder = resolve_filesystem(folder_uri)
        if folder.startswith(_HTTP_SCHEMES):
            return ()
        with _translate_errors():
            entries = filesystem.ls(folder, detail=True)
        names = [entry["name"] for entry in entries if entry["type"] == "file" or _is_link_to_file(filesystem, entry)]
        return tuple(sorted(name.rpartition("/")[2] for name in names))
    except (FileNotFoundError, NotADirectoryError):
        return ()
    except StoreError:
        raise
    except (OSError, ValueError, ImportError) as error:
        raise _unreachable_error(folder_uri, error) from error


def _is_link_to_file(filesystem: fsspec.AbstractFileSystem, entry: Mapping[str, Any]) -> bool:
    return bool(entry.get("islink")) and find_type(filesystem, entry["name"]) == "file"


@contextmanager
def _translate_errors() -> Iterator[None]:
    """Translate errors of fsspec's backends, which have no common class, into an OSError."""
    try:
        yield
    except (OSError, ValueError, ImportError):
        raise
    except Exception as error:
        status = getattr(error, "status", None)  # of an HTTP error; its text would hold the whole address, secrets too
        detail = f"{type(error).__name__}: {error}" if status is None else f"the server answers {status}"
        raise OSError(detail) from error


def _unreachable_error(uri: str, error: Exception) -> InputError:
    return InputError(f"{redact_uri(uri)!r} cannot be reached: {describe_error(error)}"[:500], "unreachable_uri")


def read_bytes(uri: str, max_bytes: int, reason: str) -> bytes:
    """Read a whole file.

    Raises:
        InputError: with `reason` if it is absent or unreadable, `file_too_large` if it is longer than `max_bytes`.
        StoreError: if an object store does not answer: that says nothing about the file.
    """
    try:
        filesystem, path = resolve_filesystem(uri)
        if isinstance(filesystem, LocalFileSystem) and filesystem.exists(path) and not filesystem.isfile(path):
            raise InputError(f"{redact_uri(uri)!r} is no regular file", reason)  # a pipe would block for ever
        with filesystem.open(path, "rb") as file:
            data = b"".join(_read_blocks(file, max_bytes + 1))
    except StoreError:
        raise
    except (OSError, ValueError, ImportError) as error:
        raise InputError(f"{redact_uri(uri)!r} cannot be read: {describe_error(error)}"[:500], reason) from error
    if len(data) > max_bytes:
        problem = f"{redact_uri(uri)!r} is longer than {max_bytes} bytes, the most that is read"
        raise InputError(problem, "file_too_large")
    return data


def _read_blocks(file: IO[bytes], most: int) -> Iterator[bytes]:
    """Yield the first `most` bytes in blocks: one read of that length would reserve the memory at once."""
    while most > 0 and (block := file.read(min(most, BLOCK_BYTES))):
        most -= len(block)
        yield block


def parse_json(data: bytes, name: str, reason: str) -> Any:
    """Parse a JSON file; NaN and infinities come through as floats, for the caller to judge."""
    if len(data) > MAX_JSON_BYTES:
        raise InputError(f"{name} is {len(data)} bytes; at most {MAX_JSON_BYTES} are parsed", reason)
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise InputError(f"{name} is no JSON: {describe_error(error)}"[:500], reason) from error
    if _bound_nesting(data) > MAX_JSON_DEPTH:
        raise InputError(f"{name} is nested deeper than {MAX_JSON_DEPTH} levels", reason)
    return value


def _bound_nesting(data: bytes) -> int:
    """Bound the nesting depth from above: brackets inside strings count too."""
    codes = np.frombuffer(data, dtype=np.uint8)
    steps = np.isin(codes, (0x5B, 0x7B)).astype(np.int32) - np.isin(codes, (0x5D, 0x7D)).astype(np.int32)
    return int(np.cumsum(steps).max(initial=0))


def open_image(data: bytes, name: str, bounds: ObserveConfig, reason: str) -> Image.Image:
    """Open a picture, reading its header only, and check its size.

    Raises:
        InputError: with `reason` if it is no picture, `picture_too_large` if it has too many pixels.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # our own bound decides, below
            warnings.simplefilter("ignore", UserWarning)  # about notes beside the pixels that are cut off
            image = Image.open(io.BytesIO(data), formats=IMAGE_FORMATS)
    except Image.DecompressionBombError as error:  # of more pixels than `observe.max_pixels` may allow
        found = "".join(_PIXELS.findall(str(error))) or "too many"
        limit = f"at most {bounds.max_pixels} (observe.max_pixels) are decoded"
        raise InputError(f"{name} has {found} pixels; {limit}", "picture_too_large") from error
    except UnidentifiedImageError as error:  # its own text holds a memory address: another one in every run
        raise InputError(f"{name} is no picture: give PNG, JPEG or WebP", reason) from error
    except _DECODE_ERRORS as error:
        raise InputError(f"{name} is no picture: {describe_error(error)}"[:500], reason) from error
    width, height = image.size
    if width * height > bounds.max_pixels:
        limit = f"at most {bounds.max_pixels} (observe.max_pixels) are decoded"
        raise InputError(f"{name} is {width} x {height} = {width * height} pixels; {limit}", "picture_too_large")
    if width < 1 or height < 1:
        raise InputError(f"{name} is {width} x {height} pixels: it has no content", reason)
    return image


def decode_image(image: Image.Image, name: str, mode: str | None, reason: str) -> np.ndarray[Any, Any]:
    """Decode the pixels, converted to `mode` if given; broken files raise InputError with `reason`."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # about palettes whose transparency is left out, as asked
            image.load()
            return np.array(image.convert(mode) if mode is not None else image)
    except _DECODE_ERRORS as error:
        raise InputError(f"{name} does not decode: {describe_error(error)}"[:500], reason) from error


def parse_finite(value: Any) -> float | None:
    """Convert a finite JSON number to a float; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None
