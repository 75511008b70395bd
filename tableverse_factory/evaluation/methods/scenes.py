"""Scenes of any method, whatever their format: what every measure of `tableverse evaluate` reads."""

from collections.abc import Callable
from dataclasses import dataclass

from schemas.geometry import ConvexPieces, Frozen, Pose, TriangleMesh
from tableverse_factory.delivery.formats.model_contents import VisualMesh


@dataclass(frozen=True, slots=True, eq=False)
class MethodObject(Frozen):
    """One object of a scene: `vertex_world = R(q) @ (scale * vertex) + position`, z up.

    Attributes:
        name: Its id in the scene.
        mesh: Its shape as one mesh, in its own frame: all that is seen, and solids that nothing seen stands for.
        looks: What is seen, with colours, part by part.
        pose: Its own frame in the scene.
        pieces: Its own convex pieces where it brings them (MJCF), else None.
        baked_scale: Scale that an export has put into the mesh already.
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
    """What one method made of one picture.

    Attributes:
        objects: All but the table.
        left_out: Names of what was taken for the table.
        camera_to_scene: Pose of the picture's camera (OpenCV axes), where it is known.
    """

    objects: tuple[MethodObject, ...]
    left_out: tuple[str, ...] = ()
    camera_to_scene: Pose | None = None


@dataclass(frozen=True, slots=True)
class Source:
    """A scene that can be read when its turn comes.

    Attributes:
        name: By which methods are compared: of the layout file, the GLB, the scene's folder, or the scene's id.
        format: `layout`, `glb`, `mjcf` or `dataset`.
        read: Reads it; raises `TableverseError` where it cannot be read.
    """

    name: str
    format: str
    read: Callable[[], MethodScene]
