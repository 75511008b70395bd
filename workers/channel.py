"""Framed messages between a sandbox and its child: eight bytes of length, then codec bytes; never pickle."""

import select
import socket
import struct
import time
from collections.abc import Callable

_LENGTH = struct.Struct("<Q")
_BLOCK = 1024 * 1024
POLL_S = 0.02


class ChannelClosedError(Exception):
    """The other end is gone."""


class Channel:
    """One end of a socket pair."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end

    def send(self, *frames: bytes) -> None:
        """Sends frames.

        Raises:
            ChannelClosedError: if nobody listens any more.
        """
        try:
            for frame in frames:
                self._socket.sendall(_LENGTH.pack(len(frame)))
                self._socket.sendall(frame)
        except OSError as error:
            raise ChannelClosedError from error

    def receive(self) -> bytes:
        """The next frame.

        Raises:
            ChannelClosedError: at the end of the stream.
        """
        (length,) = _LENGTH.unpack(self._exactly(_LENGTH.size))
        return self._exactly(length)

    def wait(self, until: float, watch: Callable[[], None]) -> bool:
        """Waits for a frame until the monotonic time `until`, calling `watch` every few milliseconds.

        Returns:
            Whether there is something to receive; also true where the other end is gone.
        """
        while True:
            left = until - time.monotonic()
            if select.select([self._socket], [], [], max(0.0, min(POLL_S, left)))[0]:
                return True
            watch()
            if left <= 0.0:
                return False

    def close(self) -> None:
        """Closes this end."""
        self._socket.close()

    def _exactly(self, length: int) -> bytes:
        data = bytearray(length)
        view = memoryview(data)
        while view:
            try:
                count = self._socket.recv_into(view[:_BLOCK])
            except OSError as error:
                raise ChannelClosedError from error
            if count == 0:
                raise ChannelClosedError
            view = view[count:]
        return bytes(data)
