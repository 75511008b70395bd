"""Arrays between the processes of one user on one machine: a count, then each as an .npy file with its length."""

import io
import json
import socket
import struct
import time
import tokenize
from collections.abc import Sequence

import numpy as np

_COUNT = struct.Struct("<I")
_LENGTH = struct.Struct("<Q")
MAX_ARRAYS = 16
MAX_BYTES = 1 << 30
"""Of one array: a picture of 200 million pixels fits."""

_NO_ARRAY = (
    ValueError,
    EOFError,
    SyntaxError,
    TypeError,
    MemoryError,
    OverflowError,
    RecursionError,
    tokenize.TokenError,
)
"""What numpy raises for a header that is none."""


class WireError(Exception):
    """The other end is gone, too slow, or says what is no message."""


def send(end: socket.socket, arrays: Sequence[np.ndarray]) -> None:
    """Sends a message.

    Raises:
        WireError: if nobody listens any more.
    """
    try:
        end.sendall(_COUNT.pack(len(arrays)))
        for array in arrays:
            held = io.BytesIO()
            np.lib.format.write_array(held, np.ascontiguousarray(array), allow_pickle=False)
            end.sendall(_LENGTH.pack(held.tell()))
            end.sendall(held.getbuffer())
    except OSError as error:
        raise WireError(str(error)) from error


def receive(end: socket.socket, within_s: float | None = None) -> list[np.ndarray]:
    """The next message.

    Args:
        end: Of the connection.
        within_s: For the whole of it; None for as long as it takes [s].

    Raises:
        WireError: at the end of the stream, after that time, or where it is no message.
    """
    until = None if within_s is None else time.monotonic() + within_s
    (count,) = _COUNT.unpack(_exactly(end, _COUNT.size, until))
    if count > MAX_ARRAYS:
        raise WireError(f"a message of {count} arrays")
    return [_array(end, until) for _ in range(count)]


def _array(end: socket.socket, until: float | None) -> np.ndarray:
    (length,) = _LENGTH.unpack(_exactly(end, _LENGTH.size, until))
    if length > MAX_BYTES:
        raise WireError(f"an array of {length} bytes")
    try:
        array: np.ndarray = np.lib.format.read_array(io.BytesIO(_exactly(end, length, until)), allow_pickle=False)
    except _NO_ARRAY as error:
        raise WireError(f"not an array: {error}") from error
    return array


def _exactly(end: socket.socket, length: int, until: float | None) -> bytearray:
    data = bytearray(length)
    view, had = memoryview(data), 0
    while had < length:
        left = None if until is None else until - time.monotonic()
        if left is not None and left <= 0.0:
            raise WireError("the other end is too slow")
        try:
            if left is not None:
                end.settimeout(left)
            got = end.recv_into(view[had:])
        except OSError as error:
            raise WireError(str(error)) from error
        if not got:
            raise WireError("the other end is gone")
        had += got
    return data


def words(kind: str, message: str) -> np.ndarray:
    """Two strings as an array of bytes: how an answer says that there is none."""
    return np.frombuffer(json.dumps([kind, message]).encode(), dtype=np.uint8)


def read_words(array: np.ndarray) -> tuple[str, str]:
    """What `words` made an array of.

    Raises:
        WireError: if it did not.
    """
    try:
        kind, message = json.loads(array.astype(np.uint8).tobytes())
    except ValueError as error:
        raise WireError("not words") from error
    return str(kind), str(message)
