"""Server side of the mesh protocol (docs/mesh-process.md): a process that makes meshes for `tableverse build`.

Runs in the model's own environment and needs only Python 3.10.
"""

import ctypes
import hashlib
import json
import os
import signal
import struct
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

PROTOCOL = 1
BOX = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1)) + (
    "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
)
"""A box as an OBJ file, for `--self-test`."""

_LENGTH = struct.Struct("<I")
_PR_SET_PDEATHSIG = 1
_MAX_REASON = 300
_MEMORY_MESSAGES = ("out of memory", "can't allocate memory", "ALLOC_FAILED")
"""Parts of messages of torch and CUDA's libraries when memory is short."""


@dataclass(frozen=True)
class ModelInfo:
    """Description of the model.

    Attributes:
        model: Name, at most 100 characters.
        version: Version of code and weights; cached meshes are made again when it changes.
        licence: Licence of the meshes.
        wants: Further inputs besides picture and mask: `depth`, `seed`; depth is sent only if wanted.
    """

    model: str
    version: str
    licence: str
    wants: tuple[str, ...] = ()


@dataclass(frozen=True)
class MeshOrder:
    """Order for the mesh of one object.

    Attributes:
        picture: The whole picture, a PNG file (RGB).
        mask: Mask of the object, a PNG file of the same size (8 bit, 0 or 255).
        seed: Random seed.
        depth: Depth along the optical axis, 0 where unknown, little-endian float32 by rows; None if not wanted [m].
        camera: fx, fy, cx, cy; pixel centres at whole numbers [px].
    """

    picture: bytes
    mask: bytes
    seed: int
    depth: bytes | None
    camera: dict[str, float]


@dataclass(frozen=True)
class MeshFile:
    """A mesh file.

    Attributes:
        data: Bytes of the file.
        format: `glb`, `ply`, `obj` or `stl`.
        up: Axis of the file's coordinates that points up, `y` or `z`.
    """

    data: bytes
    format: str
    up: str


MakeMeshes = Callable[[Sequence[MeshOrder], int], Sequence[MeshFile]]
"""Makes the meshes of at most so many orders. A network should pad its batch to that number: kernels are chosen by
shape, and a mesh must not depend on other orders."""


def hash_names(*named: object) -> str:
    """Hash names of code, weights and settings, and the text of those that are files, to eight digits."""
    hashed = hashlib.sha256()
    for name in map(str, named):
        text = Path(name).read_bytes() if Path(name).is_file() else b""
        hashed.update(f"{len(name)} {len(text)} ".encode() + name.encode(errors="surrogateescape") + text)
    return hashed.hexdigest()[:8]


def serve(
    info: ModelInfo, load: Callable[[], MakeMeshes], batch: int = 1, release: Callable[[], None] = lambda: None
) -> None:
    """Answer requests until stdin is closed.

    Args:
        info: Description of the model.
        load: Loads the weights and returns the function that makes meshes; called once, at the first need.
        batch: Number of objects made at a time.
        release: Called after an error, to free memory before the next attempt.
    """
    _end_with_parent()
    incoming, outgoing = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # prints go to stderr: stdout carries the protocol
    write_frame(outgoing, {"type": "hello", "protocol": PROTOCOL, **info.__dict__})
    make: MakeMeshes | None = None
    while (message := read_frame(incoming)) is not None:
        head, parts = message
        make = make or load()
        if head["type"] == "load":
            write_frame(outgoing, {"type": "ready"})
            continue
        orders = list(_read_orders(head, parts))
        for start in range(0, len(orders), batch):
            some = orders[start : start + batch]
            for (name, _), answer in zip(
                some, make_all(make, [order for _, order in some], batch, release), strict=True
            ):
                if isinstance(answer, str):
                    write_frame(outgoing, {"type": "failed", "id": name, "reason": answer})
                else:
                    write_frame(
                        outgoing, {"type": "mesh", "id": name, "format": answer.format, "up": answer.up}, answer.data
                    )


def make_all(
    make: MakeMeshes, orders: Sequence[MeshOrder], size: int, release: Callable[[], None]
) -> list[MeshFile | str]:
    """Make a mesh, or a reason for its absence, for each order.

    If a batch raises, each of its orders is tried alone, padded to the same size; if memory was short, in batches of
    half the size. Only then may the last digits depend on other orders.

    Raises:
        RuntimeError: for errors of CUDA other than short memory, after which no call can succeed.
    """
    try:
        return list(make(orders, size))
    except Exception as error:
        too_large = isinstance(error, MemoryError) or any(words in str(error) for words in _MEMORY_MESSAGES)
        if "CUDA error" in str(error) and not too_large:
            raise
        reason = f"{type(error).__name__}: {error}"[:_MAX_REASON]
    release()
    if len(orders) == 1 and (size == 1 or not too_large):
        return [reason]
    size, part = (size // 2, size // 2) if too_large and size > 1 else (size, 1)
    parts = [orders[start : start + part] for start in range(0, len(orders), part)]
    return [answer for some in parts for answer in make_all(make, some, size, release)]


def load_box() -> MakeMeshes:
    """Load a stand-in that makes a box of every object, to test the installation."""
    return lambda orders, _: [MeshFile(BOX.encode(), "obj", "z") for _ in orders]


def read_frame(stream: BinaryIO) -> tuple[dict[str, Any], list[bytes]] | None:
    """Read the next frame, its head and parts; None at the end."""
    length = stream.read(_LENGTH.size)
    if len(length) < _LENGTH.size:
        return None
    head: dict[str, Any] = json.loads(stream.read(_LENGTH.unpack(length)[0]))
    return head, [stream.read(size) for size in head.get("parts", [])]


def write_frame(stream: BinaryIO, head: dict[str, Any], *parts: bytes) -> None:
    """Write a frame."""
    data = json.dumps({**head, "parts": [len(part) for part in parts]}).encode()
    stream.write(_LENGTH.pack(len(data)) + data)
    for part in parts:
        stream.write(part)
    stream.flush()


def _read_orders(head: dict[str, Any], parts: list[bytes]) -> Iterator[tuple[str, MeshOrder]]:
    """Read the ids and orders of a request."""
    for entry in head["objects"]:
        view = head["pictures"][entry["picture"]]
        depth = None if view["depth"] is None else parts[view["depth"]]
        yield (
            entry["id"],
            MeshOrder(parts[view["picture"]], parts[entry["mask"]], entry["seed"], depth, view["camera"]),
        )


def _end_with_parent() -> None:
    """Let the kernel kill this process when its parent dies, even inside native code (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
