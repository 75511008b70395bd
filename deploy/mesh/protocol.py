"""Server side of the mesh protocol (docs/mesh-process.md): a process that makes meshes for `tableverse build`.

Runs in the model's own environment and needs only Python 3.10.
"""

import ctypes
import hashlib
import json
import os
import secrets
import signal
import sys
import threading
import traceback
from base64 import b64decode, b64encode
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

PROTOCOL = 2
BOX = "".join(f"v {x} {y} {z}\n" for x in (0, 1) for y in (0, 1) for z in (0, 1)) + (
    "f 1 2 4 3\nf 5 7 8 6\nf 1 5 6 2\nf 3 4 8 7\nf 1 3 7 5\nf 2 6 8 4\n"
)
"""A box as an OBJ file, for `--self-test`."""

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


class MeshServer(HTTPServer):
    """HTTP server that ends with the first error that is no matter of one object.

    Attributes:
        path: Path of requests, which only the starter of this process is told.
        answer: Answers a question.
    """

    def __init__(self, answer: Callable[[Mapping[str, Any]], Mapping[str, Any]]) -> None:
        """Listen on a free port of this machine."""
        super().__init__(("127.0.0.1", 0), MeshHandler)
        self.path, self.answer = f"/{secrets.token_urlsafe(16)}", answer

    def handle_error(self, *_: object) -> None:
        """End the process at once, with the error as its last line, unless only the connection failed."""
        if not isinstance(sys.exc_info()[1], ConnectionError):
            traceback.print_exc()
            os._exit(1)


class MeshHandler(BaseHTTPRequestHandler):
    """Handler of one request."""

    server: MeshServer
    timeout = 60.0
    """Limit for a connection that sends nothing [s]."""

    def do_POST(self) -> None:
        """Answer a question in JSON."""
        if self.path != f"{self.server.path}/meshes":
            self.send_error(404)
            return
        question = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        body = json.dumps(self.server.answer(question)).encode()
        self.send_response(200)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Log no requests: the last line of output is shown with an error."""


def serve(
    info: ModelInfo, load: Callable[[], MakeMeshes], batch: int = 1, release: Callable[[], None] = lambda: None
) -> None:
    """Answer requests until stdin is closed.

    Args:
        info: Description of the model.
        load: Loads the weights and returns the function that makes meshes; called once, at the first request.
        batch: Number of objects made at a time.
        release: Called after an error, to free memory before the next attempt.
    """
    _end_with_parent()
    make: MakeMeshes | None = None

    def answer(question: Mapping[str, Any]) -> Mapping[str, Any]:
        nonlocal make
        make = make or load()
        orders = [_read_order(question["pictures"][entry["picture"]], entry) for entry in question["objects"]]
        some = [orders[start : start + batch] for start in range(0, len(orders), batch)]
        made = [mesh for part in some for mesh in make_all(make, part, batch, release)]
        return {"meshes": [_write_answer(mesh) for mesh in made]}

    with MeshServer(answer) as server:
        url = f"http://127.0.0.1:{server.server_port}{server.path}"
        sys.stdout.write(json.dumps({"protocol": PROTOCOL, "url": url, "batch": batch, **info.__dict__}) + "\n")
        sys.stdout.flush()
        sys.stdout = sys.stderr  # which is never held back
        threading.Thread(target=_shut_down_with_stdin, args=(server,), daemon=True).start()
        server.serve_forever()


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


def _read_order(view: Mapping[str, Any], entry: Mapping[str, Any]) -> MeshOrder:
    depth = None if view["depth"] is None else b64decode(view["depth"])
    return MeshOrder(b64decode(view["picture"]), b64decode(entry["mask"]), entry["seed"], depth, view["camera"])


def _write_answer(mesh: "MeshFile | str") -> dict[str, str]:
    if isinstance(mesh, str):
        return {"error": mesh}
    return {"data": b64encode(mesh.data).decode(), "format": mesh.format, "up": mesh.up}


def _shut_down_with_stdin(server: HTTPServer) -> None:
    sys.stdin.buffer.read()
    server.shutdown()


def _end_with_parent() -> None:
    """Let the kernel kill this process when its parent dies, even inside native code (Linux)."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
