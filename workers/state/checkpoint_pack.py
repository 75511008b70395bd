"""Checkpoint packs: files of frames, one per checkpoint, each appended to by one process and read by all.

One file per checkpoint would cost more than many a stage takes. A killed process never appends again, so only the end
of a pack can be torn.
"""

import io
import os
from collections.abc import Collection, Iterator
from pathlib import Path

import pyarrow as pa

from tableverse_factory.core.framing import (
    MAX_PAYLOAD_BYTES,
    FrameError,
    FrameSpan,
    encode_header,
    read_frame,
    scan_frames,
)
from tableverse_factory.core.storage.files import atomic_file, remove

_SIZE_BYTES = 8


def parse_stage(name: str) -> str:
    """Parse the stage from a checkpoint's name; empty if it is not such a name."""
    parts = name.rsplit(".", 2)
    return parts[1] if len(parts) == 3 else ""


def encode_checkpoint(name: str, record: bytes) -> bytes:
    """Encode a record as a frame: its length, then its zstd compression, under its name."""
    packed = len(record).to_bytes(_SIZE_BYTES, "little") + pa.compress(record, codec="zstd", asbytes=True)
    return encode_header(packed, name.encode()) + packed


def decode_checkpoint(framed: bytes) -> bytes | None:
    """Decode the record of a frame; None if it is damaged."""
    try:
        _, packed = read_frame(io.BytesIO(framed).read)
    except FrameError:
        return None
    return _decompress(packed)


def append_checkpoint(descriptor: int, framed: bytes) -> None:
    """Append a frame to a pack."""
    left = memoryview(framed)
    while left:
        left = left[os.write(descriptor, left) :]


def scan_pack(pack: Path) -> Iterator[tuple[str, FrameSpan]]:
    """List the names and positions of a pack's checkpoints, up to the first torn one; contents are not read."""
    try:
        with pack.open("rb") as file:
            for span in scan_frames(file, verify=False):
                name = span.label.decode(errors="replace")
                if parse_stage(name):
                    yield name, span
    except FileNotFoundError:
        return


def read_packed_checkpoint(pack: Path, start: int) -> bytes | None:
    """Read the record in the frame at `start`; None if it is damaged, FileNotFoundError if there is no such pack."""
    with pack.open("rb") as file:
        file.seek(start)
        try:
            return _decompress(read_frame(file.read)[1])
        except FrameError:
            return None


def compact(pack: Path, stages: Collection[str]) -> None:
    """Rewrite a pack without the checkpoints of some stages; remove it if nothing is left."""
    found = list(scan_pack(pack))
    kept = [span for name, span in found if parse_stage(name) not in stages]
    if len(kept) == len(found):
        return
    if kept:
        with atomic_file(pack) as new, pack.open("rb") as old:
            for span in kept:
                old.seek(span.start)
                new.write(old.read(span.end - span.start))
    else:
        remove(pack)


def _decompress(packed: bytes) -> bytes | None:
    size = int.from_bytes(packed[:_SIZE_BYTES], "little")
    if size > MAX_PAYLOAD_BYTES:
        return None
    return pa.decompress(memoryview(packed)[_SIZE_BYTES:], decompressed_size=size, codec="zstd", asbytes=True)
