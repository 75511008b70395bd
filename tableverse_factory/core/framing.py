"""Binary frames for files, objects and sockets: a header with lengths and a checksum, a label, a payload.

    magic 4 | CRC-32 of all that follows 4 | label length 2 | payload length 8 | label | payload       (little-endian)

A frame is whole or it does not count: in a file that grows, only the end can be torn by a kill.
"""

import os
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import BinaryIO

from tableverse_factory.core.errors import BuildError

MAX_PAYLOAD_BYTES = 4 * 1024**3

_MAGIC = b"TVF1"
_OLDER_MAGICS = (b"TVJ1", b"TVR1")
_PREFIX = struct.Struct("<4sI")  # magic, checksum
_LENGTHS = struct.Struct("<HQ")  # of the label and of the payload
HEADER_BYTES = _PREFIX.size + _LENGTHS.size  # of a frame, before its label


class FrameError(Exception):
    """Bytes that are no whole frame: torn, damaged, or too long."""


@dataclass(frozen=True, slots=True)
class FrameSpan:
    """Position of a frame in its file, from the start of its header, and the size of its payload [bytes]."""

    label: bytes
    start: int
    size: int

    @property
    def offset(self) -> int:
        """Position of the payload."""
        return self.start + HEADER_BYTES + len(self.label)

    @property
    def end(self) -> int:
        """Position behind the frame."""
        return self.offset + self.size


def encode_header(payload: bytes, label: bytes = b"") -> bytes:
    """Encode the header and label that precede `payload`; write both to get a frame."""
    rest = _LENGTHS.pack(len(label), len(payload)) + label
    return _PREFIX.pack(_MAGIC, zlib.crc32(payload, zlib.crc32(rest))) + rest


def read_frame(read: Callable[[int], bytes], max_bytes: int = MAX_PAYLOAD_BYTES) -> tuple[bytes, bytes]:
    """Read label and payload of one frame; `read(n)` returns fewer than n bytes at the end alone.

    Raises:
        FrameError: if the bytes are torn or damaged, or the payload is longer than `max_bytes`.
        BuildError: if an older version wrote them.
    """
    checksum, label_size, size = _decode_header(read(HEADER_BYTES))
    if size > max_bytes:
        raise FrameError(f"a frame of {size} bytes; at most {max_bytes} are accepted")
    label, payload = read(label_size), read(size)
    if len(label) < label_size or len(payload) < size:
        raise FrameError("a torn frame")
    rest = _LENGTHS.pack(label_size, size) + label
    if zlib.crc32(payload, zlib.crc32(rest)) != checksum:
        raise FrameError("a frame with a wrong checksum")
    return label, payload


def scan_frames(file: BinaryIO, start: int = 0, *, verify: bool = True) -> Iterator[FrameSpan]:
    """Find the whole frames of a seekable file from the one at `start` up to the first that is torn or damaged.

    Without `verify`, only headers and labels are read.
    """
    file_end = file.seek(0, os.SEEK_END)
    while True:
        file.seek(start)
        try:
            _, label_size, size = _decode_header(file.read(HEADER_BYTES))
            span = FrameSpan(file.read(label_size), start, size)
            if len(span.label) < label_size or span.end > file_end:
                return
            if verify:
                file.seek(start)
                read_frame(file.read)
        except FrameError:
            return
        yield span
        start = span.end


def _decode_header(header: bytes) -> tuple[int, int, int]:
    if bytes(header[:4]) in _OLDER_MAGICS:
        raise BuildError(
            "an older version of TableVerse Factory began this build, and its intermediate files have another format: "
            "finish the build with that version, or remove .work and .stages in OUT and run the same command"
        )
    if len(header) < HEADER_BYTES:
        raise FrameError("a torn frame")
    magic, checksum = _PREFIX.unpack_from(header)
    if magic != _MAGIC:
        raise FrameError("bytes that are no frame")
    label_size, size = _LENGTHS.unpack_from(header, _PREFIX.size)
    return checksum, label_size, size
