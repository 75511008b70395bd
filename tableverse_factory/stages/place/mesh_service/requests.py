"""Requests to the mesh daemon: the objects of a scene that have no mesh yet, and their outcomes."""

import base64
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tableverse_factory.core.disk_cache import DiskCache
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.stages.place.mesh_service.process import ProcessFaultError

FORMATS = ("glb", "obj", "ply", "stl")
UPS = ("y", "z")
MAX_FAULTS_IN_A_ROW = 3  # objects of a scene at which the process fails twice, after which the scene is given up
_MAX_REASON = 300


class SceneRequest:
    """Request of a worker's `client.MeshClient` for the objects of a scene.

    Attributes:
        silence_s: Longest wait for an answer [s].
        picture: Picture with depth and intrinsics, as the process gets them.
        refused: Why the cache folder takes no meshes, which a person must resolve; else empty.
    """

    def __init__(self, request: Mapping[str, Any]) -> None:
        self._model: dict[str, Any] | None = request["model"]
        self.silence_s, self.picture, self._count = float(request["silence_s"]), request["picture"], request["count"]
        self.cache = DiskCache(Path(request["cache"]), ".json", durable=True)
        self._meshes = [MeshRequest(self, **entry) for entry in request["objects"]]
        self._faults: dict[int, str] = {}
        self._given_up = self.refused = ""

    def check_model(self, model: dict[str, Any]) -> None:
        """Drop the objects if the worker expects another model; the answer tells it which this one is."""
        if self._model != model:
            self._meshes = []

    def open_meshes(self) -> list["MeshRequest"]:
        """List the objects that still need a mesh."""
        return [] if self._given_up or self.refused else [mesh for mesh in self._meshes if mesh.reason is None]

    def fail(self, number: int, reason: str, fault: ProcessFaultError) -> None:
        """Note that an object has no mesh, and give the scene up after too many of them."""
        self._faults[number] = reason
        # Consecutive in the scene: cached meshes count like those made now.
        if all(number - before in self._faults for before in range(MAX_FAULTS_IN_A_ROW)):
            self._given_up = f"at {MAX_FAULTS_IN_A_ROW} objects in a row the mesh process failed twice: {fault}"
        elif len(self._faults) == self._count:
            self._given_up = f"the mesh process made none of {self._count} meshes: {self._faults[0]}"

    def build_answer(self, model: dict[str, Any]) -> dict[str, Any]:
        """Build the answer to the worker."""
        reasons = {str(mesh.number): mesh.reason for mesh in self._meshes if mesh.reason}
        return {"model": model, "reasons": reasons, "given_up": self._given_up, "refused": self.refused}


@dataclass(slots=True, eq=False)
class MeshRequest:
    """Request for the mesh of one object.

    Attributes:
        mask: PNG file in base64.
        number: Index in the scene.
        key: Cache key of the mesh.
        reason: Why there is no mesh; empty if one is cached, None until that is known.
    """

    scene: SceneRequest
    mask: str
    number: int
    key: str
    seed: int
    reason: str | None = None

    @property
    def is_open(self) -> bool:
        """Whether the mesh is still needed."""
        return self in self.scene.open_meshes()

    def find_cached(self) -> bool:
        """Return whether another request has cached the mesh meanwhile."""
        if self.scene.cache.get(self.key) is not None:
            self.reason = ""
        return self.reason is not None

    def store_answer(self, answer: Any, model: dict[str, Any]) -> None:
        """Note the answer of the process; cache a mesh with its model, version and licence.

        Raises:
            ProcessFaultError: if it is neither a mesh nor an error.
        """
        if not isinstance(answer, dict) or not isinstance(answer.get("error", answer.get("data")), str):
            raise ProcessFaultError("it sent an object with neither 'data' nor 'error'")
        if "error" in answer:
            self.reason = f"the model has no mesh: {sanitize_line(answer['error'], _MAX_REASON)}"
            return
        if answer.get("format") not in FORMATS or answer.get("up") not in UPS:
            self.reason = f"its mesh names no format of {', '.join(FORMATS)} with an up axis of {' or '.join(UPS)}"
            return
        try:
            base64.b64decode(answer["data"], validate=True)
        except ValueError:
            raise ProcessFaultError("it sent a mesh that is not in base64") from None
        entry = {**model, **{name: answer[name] for name in ("format", "up", "data")}}
        try:
            self.scene.cache.put(self.key, json.dumps(entry).encode())
        except OSError as error:
            self.scene.refused = (
                f"meshes cannot be kept in {self.scene.cache.folder}: {error.strerror or error}. Free space, or set "
                "TABLEVERSE_CACHE to another folder"
            )
            return
        self.reason = ""

    def fail(self, fault: ProcessFaultError) -> None:
        """Note that the process has failed twice at this object."""
        self.reason = f"the mesh process failed twice: {fault}"
        self.scene.fail(self.number, self.reason, fault)


def build_question(meshes: Sequence[MeshRequest]) -> dict[str, Any]:
    """Build the question for meshes, with each picture once."""
    scenes = list(dict.fromkeys(mesh.scene for mesh in meshes))
    objects = [{"picture": scenes.index(mesh.scene), "mask": mesh.mask, "seed": mesh.seed} for mesh in meshes]
    return {"pictures": [scene.picture for scene in scenes], "objects": objects}
