"""Framed messages between a sandbox and its child: eight bytes of length, then codec bytes; never pickle."""

import select
import socket
import struct
import time
from collections.abc import Callable

_LENGTH = struct.Struct("<Q")
_BLOCK = 256 * 1024
POLL_S = 0.02


class ChannelClosedError(Exception):
    """The other end is gone."""


class Channel:
    """One end of a socket pair."""

    def __init__(self, end: socket.socket) -> None:
        self._socket = end
        self._ahead = bytearray()

    def send(self, *frames: bytes) -> None:
        """Sends frames; small ones in one go.

        Raises:
            ChannelClosedError: if nobody listens any more.
        """
        small = bytearray()
        try:
            for frame in frames:
                small += _LENGTH.pack(len(frame))
                if len(frame) <= _BLOCK:
                    small += frame
                else:
                    self._socket.sendall(small)
                    self._socket.sendall(frame)
                    small.clear()
            if small:
                self._socket.sendall(small)
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
        if self._ahead:
            return True
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
        """The next bytes; what came with them in the same block stays for later."""
        while len(self._ahead) < length:
            block = self._read(max(_BLOCK, length - len(self._ahead)))
            self._ahead += block
        data = bytes(memoryview(self._ahead)[:length])
        del self._ahead[:length]
        return data

    def _read(self, most: int) -> bytes:
        try:
            block = self._socket.recv(most)
        except OSError as error:
            raise ChannelClosedError from error
        if not block:
            raise ChannelClosedError
        return block
