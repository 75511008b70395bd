"""Scenes of any method and format, the input of every measure of `tableverse evaluate`."""

from collections.abc import Callable
from dataclasses import dataclass

from schemas.geometry import ConvexPieces, Frozen, Pose, TriangleMesh
from tableverse_factory.delivery.formats.model_contents import VisualMesh


@dataclass(frozen=True, slots=True, eq=False)
class MethodObject(Frozen):
    """One object of a scene: `vertex_world = R(q) @ (scale * vertex) + position`, z up.

    Attributes:
        name: Id in the scene.
        mesh: Shape as one mesh in its own frame: visual meshes, and solids without a visual mesh.
        looks: Visual meshes with colours.
        pieces: Convex pieces if the file has them (MJCF), else None.
        baked_scale: Scale that an export has already applied to the mesh.
    """

    name: str
    mesh: TriangleMesh
    looks: tuple[VisualMesh, ...]
    pose: Pose
    scale: float = 1.0
    pieces: ConvexPieces | None = None
    baked_scale: float = 1.0


@dataclass(frozen=True, slots=True)
class MethodScene:
    """A scene that one method made from one picture.

    Attributes:
        objects: All objects but the table.
        left_out: Names of bodies taken for the table.
        camera_to_scene: Pose of the camera of the picture (OpenCV axes), if known.
    """

    objects: tuple[MethodObject, ...]
    left_out: tuple[str, ...] = ()
    camera_to_scene: Pose | None = None


@dataclass(frozen=True, slots=True)
class SceneSource:
    """A scene that is read lazily.

    Attributes:
        name: Name by which methods are matched: of the file or folder, or the scene id.
        format: `layout`, `glb`, `mjcf` or `dataset`.
        read: Reads the scene; raises `TableverseError` if it cannot be read.
    """

    name: str
    format: str
    read: Callable[[], MethodScene]
