"""The mesh protocol, from the model's side: what a process does that makes meshes for `tableverse build`.

Runs in the model's own environment and needs nothing but Python 3.10: see docs/mesh-process.md for the protocol.
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
"""A box as an OBJ file: the answer of `--self-test`."""

_LENGTH = struct.Struct("<I")
_PR_SET_PDEATHSIG = 1
_MAX_REASON = 300
_NO_MEMORY = ("out of memory", "can't allocate memory", "ALLOC_FAILED")
"""How torch and CUDA's libraries say so."""


@dataclass(frozen=True)
class About:
    """Who answers.

    Attributes:
        model: Its name, at most 100 characters.
        version: Of code and weights together: answers are kept under it, and asked again when it changes.
        licence: Of what it makes.
        wants: What else than picture and mask decides its answer: `depth`, `seed`; the rest is not sent.
    """

    model: str
    version: str
    licence: str
    wants: tuple[str, ...] = ()


@dataclass(frozen=True)
class Order:
    """One object to make a mesh of.

    Attributes:
        picture: The whole picture, a PNG file (RGB).
        mask: The object's pixels in it, a PNG file of the same size (8 bit, 0 or 255).
        seed: For whatever is drawn at random.
        depth: Along the optical axis [m], 0 where unknown: little-endian float32, row by row; None if not wanted.
        camera: fx, fy, cx, cy of the picture, pixel centres at whole numbers [px].
    """

    picture: bytes
    mask: bytes
    seed: int
    depth: bytes | None
    camera: dict[str, float]


@dataclass(frozen=True)
class Mesh:
    """A mesh file.

    Attributes:
        data: The file.
        format: `glb`, `ply`, `obj` or `stl`.
        up: The axis of the file's coordinates that points up, `y` or `z`.
    """

    data: bytes
    format: str
    up: str


Make = Callable[[Sequence[Order], int], Sequence[Mesh]]
"""The meshes of at most so many orders. Where a batch goes through a network at once, its tensors are to be filled up
to that number: kernels are chosen by shape, and so a mesh does not depend on what else was asked for beside it."""


def mark(*named: object) -> str:
    """Eight digits that differ where the names of code, weights or settings differ; of files, where their text does."""
    hashed = hashlib.sha256()
    for name in map(str, named):
        text = Path(name).read_bytes() if Path(name).is_file() else b""
        hashed.update(f"{len(name)} {len(text)} ".encode() + name.encode(errors="surrogateescape") + text)
    return hashed.hexdigest()[:8]


def serve(about: About, load: Callable[[], Make], batch: int = 1, release: Callable[[], None] = lambda: None) -> None:
    """Answers until the other side hangs up.

    Args:
        about: Who answers.
        load: Loads the weights and gives what makes meshes; called once, when there is something to make.
        batch: Objects that are made at a time.
        release: Called after an error, so that memory it held is free for the next try.
    """
    _end_with_parent()
    incoming, outgoing = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever prints, prints to stderr: stdout is the protocol's alone
    write(outgoing, {"type": "hello", "protocol": PROTOCOL, **about.__dict__})
    make: Make | None = None
    while (message := read(incoming)) is not None:
        head, parts = message
        make = make or load()
        if head["type"] == "load":
            write(outgoing, {"type": "ready"})
            continue
        orders = list(_orders(head, parts))
        for start in range(0, len(orders), batch):
            some = orders[start : start + batch]
            for (name, _), answer in zip(some, made(make, [order for _, order in some], batch, release), strict=True):
                if isinstance(answer, str):
                    write(outgoing, {"type": "failed", "id": name, "reason": answer})
                else:
                    write(outgoing, {"type": "mesh", "id": name, "format": answer.format, "up": answer.up}, answer.data)


def made(make: Make, orders: Sequence[Order], size: int, release: Callable[[], None]) -> list[Mesh | str]:
    """A mesh or a reason for each order.

    Where a batch raises, each of its orders is tried alone, still filled up to the size; where the memory was too
    short, batches of half that size are. Only then may the last digits depend on what was asked for beside it.

    Raises:
        RuntimeError: of CUDA other than of memory: no call can succeed in this process any more.
    """
    try:
        return list(make(orders, size))
    except Exception as error:
        too_large = isinstance(error, MemoryError) or any(words in str(error) for words in _NO_MEMORY)
        if "CUDA error" in str(error) and not too_large:
            raise
        reason = f"{type(error).__name__}: {error}"[:_MAX_REASON]
    release()
    if len(orders) == 1 and (size == 1 or not too_large):
        return [reason]
    size, part = (size // 2, size // 2) if too_large and size > 1 else (size, 1)
    parts = [orders[start : start + part] for start in range(0, len(orders), part)]
    return [answer for some in parts for answer in made(make, some, size, release)]


def load_box() -> Make:
    """A model that makes a box of everything: shows an operator that the plumbing holds."""
    return lambda orders, _: [Mesh(BOX.encode(), "obj", "z") for _ in orders]


def read(stream: BinaryIO) -> tuple[dict[str, Any], list[bytes]] | None:
    """The next frame: its head, and the parts that follow it; None at the end."""
    length = stream.read(_LENGTH.size)
    if len(length) < _LENGTH.size:
        return None
    head: dict[str, Any] = json.loads(stream.read(_LENGTH.unpack(length)[0]))
    return head, [stream.read(size) for size in head.get("parts", [])]


def write(stream: BinaryIO, head: dict[str, Any], *parts: bytes) -> None:
    """Sends a frame."""
    data = json.dumps({**head, "parts": [len(part) for part in parts]}).encode()
    stream.write(_LENGTH.pack(len(data)) + data)
    for part in parts:
        stream.write(part)
    stream.flush()


def _orders(head: dict[str, Any], parts: list[bytes]) -> Iterator[tuple[str, Order]]:
    """The objects of a request, by the ids under which they are answered."""
    for entry in head["objects"]:
        view = head["pictures"][entry["picture"]]
        depth = None if view["depth"] is None else parts[view["depth"]]
        yield (
            entry["id"],
            Order(parts[view["picture"]], parts[entry["mask"]], entry["seed"], depth, view["camera"]),
        )


def _end_with_parent() -> None:
    """This process is killed when the one that started it dies, even inside native code (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
