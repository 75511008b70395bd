"""What a keeper is asked for: the objects of a scene that have no mesh yet, and what comes of each."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tableverse_factory.core.disk_cache import DiskCache
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.stages.place.mesh_service.process import Hello, MeshFrame, ProcessFaultError

FORMATS = ("glb", "obj", "ply", "stl")
UPS = ("y", "z")
FAULTS_IN_A_ROW = 3
"""Objects of a scene, one after the other, at which the process fails twice: so many are not the objects' fault."""
_MAX_REASON = 300


class SceneRequest:
    """What a worker asks, and what has come of it.

    Attributes:
        to: Whom it means, as `described`; None where it does not know yet.
        silence_s: Longest wait between two answers [s].
        kept: Where answers are put.
    """

    def __init__(self, question: MeshFrame) -> None:
        """Takes a question of `mesh_orders`."""
        head, (self.picture, self.depth, *masks) = question.head, question.parts
        self.to: dict[str, Any] | None = head["to"]
        self.silence_s, self.camera, self._count = float(head["silence_s"]), head["camera"], head["of"]
        self.kept = DiskCache(Path(head["kept_in"]), ".frame", durable=True)
        self._meshes = [MeshRequest(self, mask, **entry) for mask, entry in zip(masks, head["objects"], strict=True)]
        self._faults: dict[int, str] = {}
        self._given_up = self._refused = ""

    def meant(self, who: dict[str, Any]) -> None:
        """Nothing is made where another process was meant: who asked is told which this one is."""
        if self.to != who:
            self._meshes = []

    def open_meshes(self) -> list["MeshRequest"]:
        """What is still to be made."""
        return [] if self._given_up or self._refused else [mesh for mesh in self._meshes if mesh.reason is None]

    def fail(self, number: int, reason: str, fault: ProcessFaultError) -> None:
        """An object has none; a scene of such is given up."""
        self._faults[number] = reason
        # In a row in the scene: what was kept of it counts as what is made now does.
        if all(number - before in self._faults for before in range(FAULTS_IN_A_ROW)):
            self._given_up = f"at {FAULTS_IN_A_ROW} objects in a row the mesh process failed twice: {fault}"
        elif len(self._faults) == self._count:
            self._given_up = f"the mesh process made none of {self._count} meshes: {self._faults[0]}"

    def refuse(self, why: str) -> None:
        """Its folder takes no meshes: a person must act, for whoever keeps them there, and for no other."""
        self._refused = why

    def told(self, who: dict[str, Any]) -> MeshFrame:
        """The answer."""
        reasons = {str(mesh.number): mesh.reason for mesh in self._meshes if mesh.reason}
        return MeshFrame({"who": who, "reasons": reasons, "given_up": self._given_up, "refused": self._refused})


@dataclass(slots=True, eq=False)
class MeshRequest:
    """An object of a scene.

    Attributes:
        scene: Whose picture it is in.
        mask: A PNG file.
        number: In its scene.
        key: Under which its mesh is kept.
        seed: For what the model draws at random.
        reason: Why it has no mesh; empty where one is kept, None until that is known.
    """

    scene: SceneRequest
    mask: bytes
    number: int
    key: str
    seed: int
    reason: str | None = None

    @property
    def is_open(self) -> bool:
        """Whether it is still to be made."""
        return self in self.scene.open_meshes()

    def is_kept(self) -> bool:
        """Whether somebody has asked for the same meanwhile."""
        if self.scene.kept.get(self.key) is not None:
            self.reason = ""
        return self.reason is not None

    def settle(self, frame: MeshFrame, who: dict[str, Any]) -> None:
        """Takes what the process says of it; a mesh is put on the disk, with who gave it and under which licence.

        Raises:
            ProcessFaultError: if that is no answer.
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
        kept = MeshFrame({**who, "format": head["format"], "up": head["up"]}, frame.parts)
        try:
            self.scene.kept.put(self.key, b"".join(kept.packed()))
        except OSError as error:
            self.scene.refuse(
                f"meshes cannot be kept in {self.scene.kept.folder}: {error.strerror or error}. Make room, or name "
                "another folder in TABLEVERSE_CACHE"
            )
            return
        self.reason = ""

    def fail(self, fault: ProcessFaultError) -> None:
        """The process has failed at it twice."""
        self.reason = f"the mesh process failed twice: {fault}"
        self.scene.fail(self.number, self.reason, fault)


def described(hello: Hello) -> dict[str, Any]:
    """Who answers, as it is told and kept."""
    return {**asdict(hello), "wants": sorted(hello.wants)}


def request_for(meshes: Mapping[str, MeshRequest]) -> MeshFrame:
    """The message that asks for these under their names, each picture in it once."""
    parts: list[bytes] = []
    pictures: list[dict[str, Any]] = []
    places: dict[SceneRequest, int] = {}
    objects = []

    def put(part: bytes) -> int:
        parts.append(part)
        return len(parts) - 1

    for name, mesh in meshes.items():
        scene = mesh.scene
        if scene not in places:
            places[scene] = len(pictures)
            depth = put(scene.depth) if scene.depth else None
            pictures.append({"picture": put(scene.picture), "depth": depth, "camera": scene.camera})
        objects.append({"id": name, "picture": places[scene], "mask": put(mesh.mask), "seed": mesh.seed})
    return MeshFrame({"type": "make", "pictures": pictures, "objects": objects}, tuple(parts))
