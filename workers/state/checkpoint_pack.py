"""Checkpoint packs: files of frames, one per checkpoint, each appended to by one process (see `AppendFiles`)."""

import io
from collections.abc import Callable, Collection, Iterator
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


def decode_checkpoint(framed: bytes) -> tuple[str, bytes] | None:
    """Decode the name and the record of a frame; None if it is damaged."""
    return _read_checkpoint(io.BytesIO(framed).read)


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


def read_packed_checkpoint(pack: Path, start: int) -> tuple[str, bytes] | None:
    """Read the name and the record of the frame at `start`; None if it is damaged."""
    with pack.open("rb") as file:
        file.seek(start)
        return _read_checkpoint(file.read)


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


def _read_checkpoint(read: Callable[[int], bytes]) -> tuple[str, bytes] | None:
    try:
        label, packed = read_frame(read)
    except FrameError:
        return None
    size = int.from_bytes(packed[:_SIZE_BYTES], "little")
    if size > MAX_PAYLOAD_BYTES:
        return None
    record = pa.decompress(memoryview(packed)[_SIZE_BYTES:], decompressed_size=size, codec="zstd", asbytes=True)
    return label.decode(errors="replace"), record
