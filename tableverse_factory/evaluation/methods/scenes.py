"""Scenes of any method and format, the input of every measure of `tableverse evaluate`."""

from collections.abc import Callable
from dataclasses import dataclass

from schemas.geometry import ConvexPieces, Frozen, Pose, TriangleMesh
from tableverse_factory.delivery.formats.model_contents import VisualMesh


@dataclass(frozen=True, slots=True, eq=False)
class MethodObject(Frozen):
    """One object of a scene: `vertex_world = R(q) @ (scale * vertex) + position`, z up."""

    name: str  # id in the scene
    mesh: TriangleMesh  # one mesh in its own frame: visual meshes, and solids without a visual mesh
    looks: tuple[VisualMesh, ...]  # visual meshes with colours
    pose: Pose
    scale: float = 1.0
    pieces: ConvexPieces | None = None  # convex pieces if the file has them (MJCF)
    baked_scale: float = 1.0  # scale that an export has already applied to the mesh


@dataclass(frozen=True, slots=True)
class MethodScene:
    """A scene that one method made from one picture."""

    objects: tuple[MethodObject, ...]  # all but the table
    left_out: tuple[str, ...] = ()  # names of bodies taken for the table
    camera_to_scene: Pose | None = None  # of the camera of the picture (OpenCV axes), if known


@dataclass(frozen=True, slots=True)
class SceneSource:
    """A scene that is read lazily."""

    name: str  # by which methods are matched: of the file or folder, or the scene id
    format: str  # `layout`, `glb`, `mjcf` or `dataset`
    read: Callable[[], MethodScene]  # raises `TableverseError` if it cannot be read
