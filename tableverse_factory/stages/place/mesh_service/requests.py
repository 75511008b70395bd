"""Requests to the mesh daemon: the objects of a scene that have no mesh yet, and their outcomes."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tableverse_factory.core.disk_cache import DiskCache
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.stages.place.mesh_service.process import Hello, MeshFrame, ProcessFaultError

FORMATS = ("glb", "obj", "ply", "stl")
UPS = ("y", "z")
MAX_FAULTS_IN_A_ROW = 3
"""Consecutive objects of a scene at which the process fails twice, after which the scene is given up."""
_MAX_REASON = 300


class SceneRequest:
    """Request of a worker for the objects of a scene.

    Attributes:
        silence_s: Longest wait between two meshes [s].
        cache: Cache of meshes.
    """

    def __init__(self, frame: MeshFrame) -> None:
        """Decode a request of `client.MeshClient`."""
        head, (self.picture, self.depth, *masks) = frame.head, frame.parts
        self._hello: dict[str, Any] | None = head["hello"]
        self.silence_s, self.camera, self._count = float(head["silence_s"]), head["camera"], head["count"]
        self.cache = DiskCache(Path(head["cache"]), ".frame", durable=True)
        self._meshes = [MeshRequest(self, mask, **entry) for mask, entry in zip(masks, head["objects"], strict=True)]
        self._faults: dict[int, str] = {}
        self._given_up = self._refused = ""

    def check_process(self, hello: dict[str, Any]) -> None:
        """Drop the objects if the worker expects another process; the answer tells it which this one is."""
        if self._hello != hello:
            self._meshes = []

    def open_meshes(self) -> list["MeshRequest"]:
        """List the objects that still need a mesh."""
        return [] if self._given_up or self._refused else [mesh for mesh in self._meshes if mesh.reason is None]

    def fail(self, number: int, reason: str, fault: ProcessFaultError) -> None:
        """Note that an object has no mesh, and give the scene up after too many of them."""
        self._faults[number] = reason
        # Consecutive in the scene: cached meshes count like those made now.
        if all(number - before in self._faults for before in range(MAX_FAULTS_IN_A_ROW)):
            self._given_up = f"at {MAX_FAULTS_IN_A_ROW} objects in a row the mesh process failed twice: {fault}"
        elif len(self._faults) == self._count:
            self._given_up = f"the mesh process made none of {self._count} meshes: {self._faults[0]}"

    def refuse(self, reason: str) -> None:
        """Note that the cache folder takes no meshes, which a person must resolve."""
        self._refused = reason

    def build_answer(self, hello: dict[str, Any]) -> MeshFrame:
        """Build the answer to the worker."""
        reasons = {str(mesh.number): mesh.reason for mesh in self._meshes if mesh.reason}
        return MeshFrame({"hello": hello, "reasons": reasons, "given_up": self._given_up, "refused": self._refused})


@dataclass(slots=True, eq=False)
class MeshRequest:
    """Request for the mesh of one object.

    Attributes:
        scene: Request that it belongs to.
        mask: PNG file.
        number: Index in the scene.
        key: Cache key of the mesh.
        seed: Random seed for the model.
        reason: Why there is no mesh; empty if one is cached, None until that is known.
    """

    scene: SceneRequest
    mask: bytes
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

    def store_answer(self, frame: MeshFrame, hello: dict[str, Any]) -> None:
        """Note the answer of the process; cache a mesh with its model, version and licence.

        Raises:
            ProcessFaultError: if the message is no answer.
        """
        head = frame.head
        if head.get("type") == "failed":
            self.reason = f"the model has no mesh: {sanitize_line(str(head.get('reason')), _MAX_REASON)}"
            return
        if head.get("type") != "mesh" or len(frame.parts) != 1:
            raise ProcessFaultError("it sent a message that is no answer")
        if head.get("format") not in FORMATS or head.get("up") not in UPS:
            self.reason = f"its mesh names no format of {', '.join(FORMATS)} with an up axis of {' or '.join(UPS)}"
            return
        entry = MeshFrame({**hello, "format": head["format"], "up": head["up"]}, frame.parts)
        try:
            self.scene.cache.put(self.key, b"".join(entry.encode_parts()))
        except OSError as error:
            self.scene.refuse(
                f"meshes cannot be kept in {self.scene.cache.folder}: {error.strerror or error}. Free space, or set "
                "TABLEVERSE_CACHE to another folder"
            )
            return
        self.reason = ""

    def fail(self, fault: ProcessFaultError) -> None:
        """Note that the process has failed twice at this object."""
        self.reason = f"the mesh process failed twice: {fault}"
        self.scene.fail(self.number, self.reason, fault)


def describe_process(hello: Hello) -> dict[str, Any]:
    """Return a hello as JSON for answers and the cache."""
    return {**asdict(hello), "wants": sorted(hello.wants)}


def build_message(meshes: Mapping[str, MeshRequest]) -> MeshFrame:
    """Build the message that requests meshes by name, with each picture once."""
    parts: list[bytes] = []
    pictures: list[dict[str, Any]] = []
    indices: dict[SceneRequest, int] = {}
    objects = []

    def put(part: bytes) -> int:
        parts.append(part)
        return len(parts) - 1

    for name, mesh in meshes.items():
        scene = mesh.scene
        if scene not in indices:
            indices[scene] = len(pictures)
            depth = put(scene.depth) if scene.depth else None
            pictures.append({"picture": put(scene.picture), "depth": depth, "camera": scene.camera})
        objects.append({"id": name, "picture": indices[scene], "mask": put(mesh.mask), "seed": mesh.seed})
    return MeshFrame({"type": "make", "pictures": pictures, "objects": objects}, tuple(parts))
