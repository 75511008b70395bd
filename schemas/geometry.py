"""Shapes and poses that flow between stages: frozen, slotted, with read-only arrays.

Lengths in metres, angles in radians, quaternions wxyz. Camera frames have OpenCV axes (x right, y down, z forward);
the table frame has z up, its origin on the table plane, x to the camera's right and y away from the camera.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Float64, Int32, UInt8

Vector3 = Float64[np.ndarray, "3"]
Quaternion = Float64[np.ndarray, "4"]
Matrix3 = Float64[np.ndarray, "3 3"]
Matrix4 = Float64[np.ndarray, "4 4"]
Points = Float64[np.ndarray, "n 3"]
Faces = Int32[np.ndarray, "m 3"]
Colors = UInt8[np.ndarray, "n 3"]
Picture = UInt8[np.ndarray, "h w 3"]
DepthImage = Float[np.ndarray, "h w"]
IdImage = Int32[np.ndarray, "h w"]
Mask = Bool[np.ndarray, "h w"]

TABLE_ID = -1  # of table-top pixels in an image of ids


class Frozen:
    """Mixin that makes the arrays of frozen dataclasses read-only, which `frozen=True` alone does not."""

    __slots__ = ()

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:  # type: ignore[attr-defined]
            value: Any = getattr(self, name)
            if isinstance(value, np.ndarray) and value.flags.writeable:
                view = value.view()
                view.flags.writeable = False
                object.__setattr__(self, name, view)


@dataclass(frozen=True, slots=True, eq=False)
class Pose(Frozen):
    """Rigid motion from a local frame to its parent: `parent = R(q) @ local + position`.

    Attributes:
        position: Origin of the local frame in the parent frame [m].
        quaternion_wxyz: Unit quaternion, real part first.
    """

    position: Vector3
    quaternion_wxyz: Quaternion


@dataclass(frozen=True, slots=True)
class Camera:
    """Pinhole camera without distortion; pixel centres at whole numbers [px]."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


@dataclass(frozen=True, slots=True, eq=False)
class Texture(Frozen):
    """A picture on the faces of a mesh.

    Attributes:
        picture: Shape (h, w, 3) sRGB.
        corner_uv: Points of the picture at each face's corners, 0–1, u right, v up; beyond, it repeats. (m, 3, 2).
    """

    picture: Picture
    corner_uv: Float64[np.ndarray, "m 3 2"]


@dataclass(frozen=True, slots=True, eq=False)
class TriangleMesh(Frozen):
    """Triangles in the mesh's own frame, counter-clockwise seen from outside.

    Attributes:
        vertices: Shape (n, 3) [m].
        faces: Shape (m, 3), indices into `vertices`.
        vertex_colors: Shape (n, 3) sRGB, or None; `texture` has finer colours of the same surface.
    """

    vertices: Points
    faces: Faces
    vertex_colors: Colors | None = None
    texture: Texture | None = None


@dataclass(frozen=True, slots=True, eq=False)
class ConvexPieces(Frozen):
    """Convex decomposition of a mesh, in the mesh's own frame and at scale 1.

    Attributes:
        hulls: Convex hulls as closed triangle meshes of at most 64 vertices each.
        volume_ratio: Volume of the union of the pieces over the volume of the mesh.
        hausdorff_m: Two-sided Hausdorff distance between the surfaces of mesh and pieces, by samples [m].
        method: `convex` (nearly convex, one hull), `cut` (across principal axes, then merged) or `coacd`.
        repaired: Repair of the mesh before: empty, `merged`, `oriented`, `filled` or `remeshed`.
        uncovered_m: How far the mesh sticks out of its pieces, by up to 30,000 of its vertices and 10,000 points of its
            surface [m]; a thorn between them may stick out further.
        cavity_kept: Share of the space between the mesh and its convex hull that the pieces leave open, 0 to 1.
    """

    hulls: tuple[TriangleMesh, ...]
    volume_ratio: float
    hausdorff_m: float
    method: str
    repaired: str = ""
    uncovered_m: float = 0.0
    cavity_kept: float = 1.0
