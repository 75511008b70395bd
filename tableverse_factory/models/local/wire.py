"""Messages of arrays between the processes of one user on one machine: a frame for each array, as an .npy file."""

import io
import json
import socket
import time
import tokenize
from collections.abc import Sequence
from functools import partial

import numpy as np

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.framing import FrameError, encode_header, read_frame

MAX_ARRAYS = 16
MAX_BYTES = 1 << 30  # maximum size of one array: a picture of 200 million pixels fits

# Errors that numpy raises for a malformed header.
_ARRAY_ERRORS = (
    *(ValueError, EOFError, SyntaxError, TypeError),
    *(MemoryError, OverflowError, RecursionError, tokenize.TokenError),
)


class WireError(Exception):
    """The other end is gone, too slow, or sends no message."""


def send_arrays(connection: socket.socket, arrays: Sequence[np.ndarray]) -> None:
    """Send a message; the label of each frame is the number of arrays that follow it."""
    try:
        for following, array in zip(reversed(range(len(arrays))), arrays, strict=True):
            file = io.BytesIO()
            np.lib.format.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
            connection.sendall(encode_header(file.getvalue(), b"%d" % following))
            connection.sendall(file.getbuffer())
    except OSError as error:
        raise WireError(str(error)) from error


def receive_arrays(connection: socket.socket, within_s: float | None = None) -> list[np.ndarray]:
    """Receive the next message; WireError at the end of the stream, after `within_s` [s], or for other bytes."""
    until = None if within_s is None else time.monotonic() + within_s
    arrays: list[np.ndarray] = []
    following = b""
    while following != b"0":
        if len(arrays) == MAX_ARRAYS:
            raise WireError(f"a message of more than {MAX_ARRAYS} arrays")
        try:
            following, data = read_frame(partial(_receive_exactly, connection, until=until), MAX_BYTES)
            arrays.append(np.lib.format.read_array(io.BytesIO(data), allow_pickle=False))
        except (FrameError, BuildError, *_ARRAY_ERRORS) as error:
            raise WireError(f"not an array: {error}") from error
    return arrays


def _receive_exactly(connection: socket.socket, length: int, until: float | None) -> bytes:
    data = bytearray(length)
    view, received = memoryview(data), 0
    while received < length:
        left = None if until is None else until - time.monotonic()
        if left is not None and left <= 0.0:
            raise WireError("the other end is too slow")
        try:
            if left is not None:
                connection.settimeout(left)
            count = connection.recv_into(view[received:])
        except OSError as error:
            raise WireError(str(error)) from error
        if not count:
            raise WireError("the other end is gone")
        received += count
    return bytes(data)


def encode_error(kind: str, message: str) -> np.ndarray:
    """Encode the class and message of an error as an array of bytes."""
    return np.frombuffer(json.dumps([kind, message]).encode(), dtype=np.uint8)


def decode_error(array: np.ndarray) -> tuple[str, str]:
    """Decode the class and message of an error; WireError if the array holds none."""
    try:
        kind, message = json.loads(array.astype(np.uint8).tobytes())
    except ValueError as error:
        raise WireError("not an error message") from error
    return str(kind), str(message)
