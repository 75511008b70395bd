"""Meshes asked of a mesh process: kept answers first, the rest in one request, what goes wrong object by object."""

import io
import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from PIL import Image

from schemas.geometry import Camera, DepthImage, Frozen, Mask, Picture
from schemas.identity import content_hash
from tableverse_factory.checked_files import CheckedFiles
from tableverse_factory.errors import ModelAccessError, ModelError
from tableverse_factory.place.mesh_process import Frame, Hello, MeshProcess, ProcessFaultError, running
from tableverse_factory.services import Services
from tableverse_factory.text import printable

FORMATS = ("glb", "obj", "ply", "stl")
UPS = ("y", "z")
FAULTS_IN_A_ROW = 3
"""Objects of a scene, one after the other, at which the process fails twice: so many are not the objects' fault."""
_VERSION = b"meshes 2"
_MAX_REASON = 300


@dataclass(frozen=True, slots=True, eq=False)
class View(Frozen):
    """A picture, of which one or more objects are wanted.

    Attributes:
        color: Shape (h, w, 3) sRGB.
        depth: Shape (h, w), along the optical axis [m]; 0 where unknown.
        camera: Intrinsics of both.
    """

    color: Picture
    depth: DepthImage
    camera: Camera


@dataclass(frozen=True, slots=True, eq=False)
class Order(Frozen):
    """One object of a picture.

    Attributes:
        view: The picture; objects of one picture share it.
        mask: The object's pixels in it. Shape (h, w).
        seed: For what the model draws at random.
    """

    view: View
    mask: Mask
    seed: int


@dataclass(frozen=True, slots=True)
class MeshFile:
    """A mesh as a model gave it: untrusted.

    Attributes:
        data: The file.
        format: One of `FORMATS`.
        up: The axis of the file's coordinates that points up.
    """

    data: bytes
    format: str
    up: str


Answer = MeshFile | str
"""A mesh, or why there is none, in one line."""


class MeshMaker:
    """Asks the process of one command."""

    def __init__(self, command: tuple[str, ...], silence_s: float, services: Services) -> None:
        """Takes the command, the longest wait between two answers [s], and where answers are kept."""
        self._command, self._silence_s = command, silence_s
        self._kept = CheckedFiles(services.cache_dir / "meshes", ".frame", durable=True)

    def make(self, orders: Sequence[Order]) -> tuple[Hello, list[Answer]]:
        """Who answered, and an answer to each order.

        A process that dies, falls silent or sends nonsense is replaced, and what it owed is asked for once more, an
        object at a time; an object that does it again has no mesh.

        Raises:
            ModelAccessError: if no process can be started, or the disk refuses to keep answers.
            ModelError: if it answered nothing at all of what it was asked, or failed at `FAULTS_IN_A_ROW`.
        """
        hello = running(self._command).hello
        keys = _keys(hello, orders)
        found: dict[int, Answer] = {}
        for number, key in enumerate(keys):
            if (kept := self._kept.get(key)) is not None:
                found[number] = _unpacked(kept)
        missing = [number for number in range(len(orders)) if number not in found]
        faults = self._ask_twice(orders, missing, found, keys) if missing else {}
        if orders and len(faults) == len(orders):
            raise ModelError(f"the mesh process made none of {len(orders)} meshes: {faults[0]}")
        return hello, [found[number] if number in found else faults[number] for number in range(len(orders))]

    def _ask_twice(
        self, orders: Sequence[Order], missing: Sequence[int], found: dict[int, Answer], keys: Sequence[str]
    ) -> dict[int, str]:
        """Fills in what is missing; the reasons of those for which the process failed again."""
        faults: dict[int, str] = {}
        try:
            self._ask(orders, missing, found, keys)
        except ProcessFaultError:
            for number in [number for number in missing if number not in found]:
                try:
                    self._ask(orders, [number], found, keys)
                except ProcessFaultError as fault:
                    faults[number] = f"the mesh process failed twice: {fault}"
                    # In a row in the scene: what was kept of it counts as what is made now does.
                    if all(number - before in faults for before in range(FAULTS_IN_A_ROW)):
                        raise ModelError(
                            f"at {FAULTS_IN_A_ROW} objects in a row the mesh process failed twice: {fault}"
                        ) from fault
        return faults

    def _ask(
        self, orders: Sequence[Order], wanted: Sequence[int], found: dict[int, Answer], keys: Sequence[str]
    ) -> None:
        """One request for all that is wanted; answers are kept as they come.

        Raises:
            ProcessFaultError: if the process is of no use any more; it is ended then.
        """
        process = running(self._command)
        process.load()
        try:
            process.send(_request(process.hello, {number: orders[number] for number in wanted}), self._silence_s)
            owed = {str(number) for number in wanted}
            while owed:
                number, answer = _read(process.receive(self._silence_s), owed)
                owed.discard(str(number))
                found[number] = answer
                if isinstance(answer, MeshFile):
                    self._keep(keys[number], answer, process.hello)
        except ProcessFaultError as fault:
            raise _ended(process, fault) from fault

    def _keep(self, key: str, answer: MeshFile, hello: Hello) -> None:
        """Puts an answer on disk, with who gave it and under which licence."""
        head = {**asdict(hello), "wants": sorted(hello.wants), "format": answer.format, "up": answer.up}
        try:
            self._kept.put(key, b"".join(Frame(head, (answer.data,)).packed()))
        except OSError as error:
            raise ModelAccessError(
                f"meshes cannot be kept in {self._kept.folder}: {error.strerror or error}. Make room, or name another "
                "folder in TABLEVERSE_CACHE"
            ) from error


def _ended(process: MeshProcess, fault: ProcessFaultError) -> ProcessFaultError:
    """Ends a process that is of no use any more; the fault with its last words."""
    process.close()
    said = process.last_words()
    return ProcessFaultError(f"{fault}; it says: {said}" if said else str(fault))


def _keys(hello: Hello, orders: Sequence[Order]) -> list[str]:
    """Hashes of what decides each answer: who answers under which licence, and all that it is sent to go by."""
    pictures: dict[int, bytes] = {}
    who = [word.encode() for word in (hello.model, hello.version, hello.licence)]
    keys = []
    for order in orders:
        view, camera = order.view, order.view.camera
        if id(view) not in pictures:
            intrinsics = struct.pack("<4d", camera.fx, camera.fy, camera.cx, camera.cy)
            parts = [str(view.color.shape).encode(), view.color.tobytes(), intrinsics]
            if "depth" in hello.wants:
                parts.append(_depth(view))
            pictures[id(view)] = content_hash(*parts).encode()
        seed = str(order.seed).encode() if "seed" in hello.wants else b""
        keys.append(content_hash(_VERSION, *who, pictures[id(view)], np.packbits(order.mask).tobytes(), seed))
    return keys


def _request(hello: Hello, orders: Mapping[int, Order]) -> Frame:
    """The message that asks for these, each picture in it once."""
    parts: list[bytes] = []
    pictures: list[dict[str, Any]] = []
    places: dict[int, int] = {}
    objects = []

    def put(part: bytes) -> int:
        parts.append(part)
        return len(parts) - 1

    for number, order in orders.items():
        view, camera = order.view, order.view.camera
        if id(view) not in places:
            places[id(view)] = len(pictures)
            depth = put(_depth(view)) if "depth" in hello.wants else None
            intrinsics = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
            pictures.append({"picture": put(_png(view.color)), "depth": depth, "camera": intrinsics})
        mask = put(_png(np.where(order.mask, 255, 0).astype(np.uint8)))
        objects.append({"id": str(number), "picture": places[id(view)], "mask": mask, "seed": order.seed})
    return Frame({"type": "make", "pictures": pictures, "objects": objects}, tuple(parts))


def _read(frame: Frame, owed: set[str]) -> tuple[int, Answer]:
    """An object's number and answer."""
    head, name = frame.head, frame.head.get("id")
    if not isinstance(name, str) or name not in owed:
        raise ProcessFaultError("it answered for an object that was not asked for")
    if head.get("type") == "failed":
        return int(name), f"the model has no mesh: {printable(str(head.get('reason')), _MAX_REASON)}"
    if head.get("type") != "mesh" or len(frame.parts) != 1:
        raise ProcessFaultError("it sent a message that is no answer")
    if head.get("format") not in FORMATS or head.get("up") not in UPS:
        return int(name), f"its mesh names no format of {', '.join(FORMATS)} with an up axis of {' or '.join(UPS)}"
    return int(name), MeshFile(frame.parts[0], head["format"], head["up"])


def _unpacked(kept: bytes) -> MeshFile:
    """A kept answer; its checksum was right, so it is as it was written."""
    (length,) = struct.unpack_from("<I", kept)
    head = json.loads(kept[4 : 4 + length])
    return MeshFile(kept[4 + length :], head["format"], head["up"])


def _depth(view: View) -> bytes:
    return np.ascontiguousarray(view.depth, dtype="<f4").tobytes()


def _png(image: np.ndarray) -> bytes:
    data = io.BytesIO()
    Image.fromarray(image).save(data, "PNG", compress_level=1)
    return data.getvalue()
