"""Frames over the socket pair between a sandbox and its child; never pickle."""

import select
import socket
import time
from collections.abc import Callable

from tableverse_factory.core.framing import FrameError, encode_header, read_frame

_BLOCK_BYTES = 256 * 1024
POLL_S = 0.02


class ChannelClosedError(Exception):
    """The other end is gone, or sent bytes that are no frame."""


class Channel:
    """One end of a socket pair."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._buffer = bytearray()

    def send(self, *messages: bytes) -> None:
        """Send a frame for each message, small ones in one system call; ChannelClosedError if the other end is gone."""
        pending = bytearray()
        try:
            for message in messages:
                pending += encode_header(message)
                if len(message) <= _BLOCK_BYTES:
                    pending += message
                else:
                    self._socket.sendall(pending)
                    self._socket.sendall(message)
                    pending.clear()
            if pending:
                self._socket.sendall(pending)
        except OSError as error:
            raise ChannelClosedError from error

    def receive(self) -> bytes:
        """Receive the next message; ChannelClosedError at the end of the stream, or if it is damaged."""
        try:
            return read_frame(self._receive_exactly)[1]
        except FrameError as error:
            raise ChannelClosedError from error

    def wait(self, until: float, watch: Callable[[], None]) -> bool:
        """Wait until the monotonic time `until`, calling `watch`; True for a message, or if the other end is gone."""
        if self._buffer:
            return True
        while True:
            left = until - time.monotonic()
            if select.select([self._socket], [], [], max(0.0, min(POLL_S, left)))[0]:
                return True
            watch()
            if left <= 0.0:
                return False

    def close(self) -> None:
        """Close this end."""
        self._socket.close()

    def _receive_exactly(self, length: int) -> bytes:
        """Receive `length` bytes; what arrives with them stays in the buffer."""
        while len(self._buffer) < length:
            try:
                block = self._socket.recv(max(_BLOCK_BYTES, length - len(self._buffer)))
            except OSError as error:
                raise ChannelClosedError from error
            if not block:
                raise ChannelClosedError
            self._buffer += block
        data = bytes(memoryview(self._buffer)[:length])
        del self._buffer[:length]
        return data
