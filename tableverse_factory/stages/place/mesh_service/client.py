"""Client of a mesh process: cached meshes first, the others from its daemon."""

import base64
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
from tableverse_factory.stages.place.mesh_service.daemon import build_spec, request_meshes

_VERSION = b"meshes 2"
_MAX_ROUNDS = 4  # of cache lookup and request: to learn who answers, to request meshes, to read them, one to spare
_MODEL_CACHE: dict[str, dict[str, Any]] = {}  # model behind each command, as last received by this worker


@dataclass(frozen=True, slots=True, eq=False)
class RgbdImage(Frozen):
    """Picture, shape (h, w, 3) sRGB, and depth along the optical axis, shape (h, w) [m], 0 where unknown."""

    color: Picture
    depth: DepthImage
    camera: Camera


@dataclass(frozen=True, slots=True, eq=False)
class MeshQuery(Frozen):
    """Pixels of one object, shape (h, w), and the seed for the model."""

    mask: Mask
    seed: int


@dataclass(frozen=True, slots=True)
class MeshFile:
    """Untrusted mesh file, one of `requests.FORMATS` and `requests.UPS`; `model` has its version."""

    data: bytes
    format: str
    up: str
    model: str
    licence: str


MeshAnswer = MeshFile | str  # a mesh, or the reason why there is none, in one line


class MeshClient:
    """Client of the process of one command (program and arguments), which is silent for at most `silence_s` [s]."""

    def __init__(self, command: tuple[str, ...], silence_s: float, services: Services) -> None:
        self._command, self._silence_s = command, silence_s
        self._cache = DiskCache(services.cache_dir / "meshes", ".json", durable=True)

    def make_meshes(self, view: RgbdImage, queries: Sequence[MeshQuery]) -> list[MeshAnswer]:
        """Make the meshes of a scene; a known process whose meshes are all cached is not asked.

        Raises:
            ModelAccessError: if the process cannot be started, or meshes cannot be cached.
            ModelError: if the process made no mesh, or failed at several objects in a row.
        """
        reasons: dict[int, str] = {}
        spec = json.dumps(build_spec(self._command))
        for _ in range(_MAX_ROUNDS):
            model = _MODEL_CACHE.get(spec)
            keys = _compute_keys(model, view, queries) if model else []
            cached = {number: mesh for number, key in enumerate(keys) if (mesh := self._read_cached(key)) is not None}
            answers = cached | reasons
            missing = {number: key for number, key in enumerate(keys) if number not in answers}
            if model and not missing:
                return [answers[number] for number in range(len(queries))]
            answer = request_meshes(self._command, self._build_request(model, view, queries, missing))
            if answer["refused"]:
                raise ModelAccessError(answer["refused"])
            if answer["given_up"]:
                raise ModelError(answer["given_up"])
            _MODEL_CACHE[spec] = answer["model"]
            is_same = answer["model"] == model
            reasons = {int(number): reason for number, reason in answer["reasons"].items()} if is_same else {}
        raise ModelError("cached meshes disappear while they are made, or the mesh process changes again and again")

    def _read_cached(self, key: str) -> MeshFile | None:
        if (data := self._cache.get(key)) is None:
            return None
        entry = json.loads(data)
        model = f"{entry['model']}@{entry['version']}"
        return MeshFile(base64.b64decode(entry["data"]), entry["format"], entry["up"], model, entry["licence"])

    def _build_request(
        self, model: Mapping[str, Any] | None, view: RgbdImage, queries: Sequence[MeshQuery], missing: Mapping[int, str]
    ) -> dict[str, Any]:
        camera = view.camera
        picture = {
            "picture": _encode(encode_png(view.color, compress_level=1)) if missing else "",
            "depth": _encode(_encode_depth(view)) if missing and model and "depth" in model["wants"] else None,
            "camera": {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy},
        }
        masks = {number: np.where(queries[number].mask, 255, 0).astype(np.uint8) for number in missing}
        objects = [
            {
                "number": number,
                "key": key,
                "seed": queries[number].seed,
                "mask": _encode(encode_png(masks[number], compress_level=1)),
            }
            for number, key in missing.items()
        ]
        return {
            "model": model,
            "count": len(queries),
            "cache": str(self._cache.folder.absolute()),
            "silence_s": self._silence_s,
            "picture": picture,
            "objects": objects,
        }


def _compute_keys(model: Mapping[str, Any], view: RgbdImage, queries: Sequence[MeshQuery]) -> list[str]:
    """Hash all that determines each mesh: model, version and licence, and the data that the model uses."""
    camera = view.camera
    intrinsics = struct.pack("<4d", camera.fx, camera.fy, camera.cx, camera.cy)
    parts = [str(view.color.shape).encode(), view.color.tobytes(), intrinsics]
    if "depth" in model["wants"]:
        parts.append(_encode_depth(view))
    shared = [_VERSION, *(model[name].encode() for name in ("model", "version", "licence"))]
    shared.append(content_hash(*parts).encode())
    has_seed = "seed" in model["wants"]
    return [
        content_hash(*shared, np.packbits(query.mask).tobytes(), str(query.seed).encode() if has_seed else b"")
        for query in queries
    ]


def _encode(data: bytes) -> str:
    return base64.b64encode(data).decode()


def _encode_depth(view: RgbdImage) -> bytes:
    return np.ascontiguousarray(view.depth, dtype="<f4").tobytes()
