"""Meshes asked of a mesh process: kept answers first, the rest of its keeper, what goes wrong object by object."""

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from schemas.geometry import Camera, DepthImage, Frozen, Mask, Picture
from schemas.identity import content_hash
from tableverse_factory.core.disk_cache import DiskCache
from tableverse_factory.core.errors import ModelAccessError, ModelError
from tableverse_factory.core.png import encode_png
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.mesh_service.daemon import ask_keeper, spec_of
from tableverse_factory.stages.place.mesh_service.process import MeshFrame

_VERSION = b"meshes 2"
_TURNS = 4
"""Looks at what is kept: before anything is known of the process, before it is asked, after that, and one to spare."""
_HELLO_CACHE: dict[str, dict[str, Any]] = {}
"""Who answers behind the spec of a command, as this worker was told last."""


@dataclass(frozen=True, slots=True, eq=False)
class RgbdImage(Frozen):
    """The picture of a scene.

    Attributes:
        color: Shape (h, w, 3) sRGB.
        depth: Shape (h, w), along the optical axis [m]; 0 where unknown.
        camera: Intrinsics of both.
    """

    color: Picture
    depth: DepthImage
    camera: Camera


@dataclass(frozen=True, slots=True, eq=False)
class MeshQuery(Frozen):
    """One object of a picture.

    Attributes:
        mask: The object's pixels in it. Shape (h, w).
        seed: For what the model draws at random.
    """

    mask: Mask
    seed: int


@dataclass(frozen=True, slots=True)
class MeshFile:
    """A mesh as a model gave it: untrusted.

    Attributes:
        data: The file.
        format: One of `mesh_wanted.FORMATS`.
        up: The axis of the file's coordinates that points up.
        model: Who made it, with its version.
        licence: Of the mesh, as its maker says.
    """

    data: bytes
    format: str
    up: str
    model: str
    licence: str


Answer = MeshFile | str
"""A mesh, or why there is none, in one line."""


class MeshClient:
    """Asks the process of one command."""

    def __init__(self, command: tuple[str, ...], silence_s: float, services: Services) -> None:
        """Takes the command, the longest wait between two answers [s], and where answers are kept."""
        self._command, self._silence_s = command, silence_s
        self._kept = DiskCache(services.cache_dir / "meshes", ".frame", durable=True)

    def make(self, view: RgbdImage, orders: Sequence[MeshQuery]) -> list[Answer]:
        """An answer to each order of a scene. Who is known and whose answers are all kept is not asked.

        Raises:
            ModelAccessError: if no process can be started, or the disk refuses to keep answers.
            ModelError: if it made nothing of what it was asked, or failed at one object after the other.
        """
        reasons: dict[int, str] = {}
        spec = json.dumps(spec_of(self._command))
        for _ in range(_TURNS):
            who = _HELLO_CACHE.get(spec)
            keys = _keys(who, view, orders) if who else []
            found = {number: kept for number, key in enumerate(keys) if (kept := self._look(key)) is not None}
            answers = found | reasons
            missing = {number: key for number, key in enumerate(keys) if number not in answers}
            if who and not missing:
                return [answers[number] for number in range(len(orders))]
            told = ask_keeper(self._command, self._question(who, view, orders, missing)).head
            if told["refused"]:
                raise ModelAccessError(told["refused"])
            if told["given_up"]:
                raise ModelError(told["given_up"])
            _HELLO_CACHE[spec] = told["who"]
            reasons = {int(number): reason for number, reason in told["reasons"].items()} if told["who"] == who else {}
        raise ModelError("meshes do not stay where they are kept, or the mesh process changes all the time")

    def _look(self, key: str) -> MeshFile | None:
        """A kept answer; its checksum was right, so it is as it was written."""
        if (kept := self._kept.get(key)) is None:
            return None
        frame = MeshFrame.read(kept)
        head = frame.head
        model = f"{head['model']}@{head['version']}"
        return MeshFile(frame.parts[0], head["format"], head["up"], model, head["licence"])

    def _question(
        self, who: Mapping[str, Any] | None, view: RgbdImage, orders: Sequence[MeshQuery], missing: Mapping[int, str]
    ) -> MeshFrame:
        """What the keeper is asked: the view once, and the mask of each object that is missing."""
        camera = view.camera
        head = {
            "to": who,
            "of": len(orders),
            "kept_in": str(self._kept.folder.absolute()),
            "silence_s": self._silence_s,
            "camera": {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
            "objects": [{"number": number, "key": key, "seed": orders[number].seed} for number, key in missing.items()],
        }
        picture = encode_png(view.color, compress_level=1) if missing else b""
        depth = _depth(view) if missing and who and "depth" in who["wants"] else b""
        masks = [
            encode_png(np.where(orders[number].mask, 255, 0).astype(np.uint8), compress_level=1) for number in missing
        ]
        return MeshFrame(head, (picture, depth, *masks))


def _keys(who: Mapping[str, Any], view: RgbdImage, orders: Sequence[MeshQuery]) -> list[str]:
    """Hashes of what decides each answer: who answers under which licence, and all that it is sent to go by."""
    camera = view.camera
    intrinsics = struct.pack("<4d", camera.fx, camera.fy, camera.cx, camera.cy)
    parts = [str(view.color.shape).encode(), view.color.tobytes(), intrinsics]
    if "depth" in who["wants"]:
        parts.append(_depth(view))
    shared = [_VERSION, *(who[name].encode() for name in ("model", "version", "licence"))]
    shared.append(content_hash(*parts).encode())
    has_seed = "seed" in who["wants"]
    return [
        content_hash(*shared, np.packbits(order.mask).tobytes(), str(order.seed).encode() if has_seed else b"")
        for order in orders
    ]


def _depth(view: RgbdImage) -> bytes:
    return np.ascontiguousarray(view.depth, dtype="<f4").tobytes()
