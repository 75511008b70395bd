"""Solids of the generators with their convex pieces: revolved, shells, lofts, prisms.

A `Solid` is a closed manifold (manifold3d) next to corner sets of convex bodies that cover it. Building both from the
same numbers keeps cavities open and costs nothing, where a decomposition of the mesh would take seconds.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float64
from manifold3d import CrossSection, JoinType, Manifold, Mesh64

from schemas.geometry import Points, TriangleMesh
from tableverse_factory.core.errors import GeometryError

SEGMENTS = 48
WEDGES = 16
WALL_LIFT_M = 0.0006

Profile = Float64[np.ndarray, "k 2"]  # Radius and height [m], from the bottom up
Rings = Float64[np.ndarray, "k m 3"]  # Closed curves of equally many points [m], one after the other along a tube


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A closed body, and corners of convex bodies that cover it, each of shape (k, 3) [m]."""

    manifold: Manifold
    pieces: tuple[Points, ...]

    def __add__(self, other: "Solid") -> "Solid":
        return Solid(self.manifold + other.manifold, self.pieces + other.pieces)

    def translate(self, offset: Sequence[float]) -> "Solid":
        """Translate the solid [m]."""
        shift = np.asarray(offset, dtype=np.float64)
        return Solid(self.manifold.translate(tuple(shift)), tuple(piece + shift for piece in self.pieces))

    def rotate(self, degrees_xyz: Sequence[float]) -> "Solid":
        """Rotate the solid about x, then y, then z [degrees], as manifold3d does."""
        x, y, z = (_make_axis_rotation(axis, np.deg2rad(angle)) for axis, angle in enumerate(degrees_xyz))
        rotation = z @ y @ x
        turned = self.manifold.transform(np.hstack([rotation, np.zeros((3, 1))]))
        return Solid(turned, tuple(piece @ rotation.T for piece in self.pieces))

    def to_mesh(self) -> TriangleMesh:
        """Convert the surface to a triangle mesh."""
        found = self.manifold.to_mesh64()
        if self.manifold.is_empty() or self.manifold.volume() <= 0.0:
            raise GeometryError(f"a generated solid is empty: {self.manifold.status()}")
        vertices = np.array(found.vert_properties[:, :3], dtype=np.float64)
        return TriangleMesh(vertices, np.array(found.tri_verts, dtype=np.int32))


def make_hull(points: Points) -> Solid:
    """Make the convex hull of points."""
    return Solid(Manifold.hull_points(np.ascontiguousarray(points)), (points,))


def make_block(size: Sequence[float], corner: float = 0.0) -> Solid:
    """Make a box that stands on z = 0, centred on the z axis; `corner` rounds its upright edges [m]."""
    return make_prism([(size[0], size[1])], corner, size[2])


def make_prism(sizes: Sequence[tuple[float, float]], corner: float, height: float) -> Solid:
    """Make the hull of rounded rectangles at equal steps of height from z = 0."""
    rings = [_make_rounded_rectangle(x, y, corner) for x, y in (sizes if len(sizes) > 1 else [sizes[0], sizes[0]])]
    heights = np.linspace(0.0, height, len(rings))
    layers = (np.column_stack([ring, np.full(len(ring), z)]) for ring, z in zip(rings, heights, strict=True))
    return make_hull(np.concatenate(list(layers)))


def revolve(profile: Profile) -> Solid:
    """Make a full body of revolution about z; its pieces are the convex runs of the profile."""
    outline = np.vstack([[0.0, profile[0, 1]], profile, [0.0, profile[-1, 1]]])
    pieces = tuple(_revolve_profile(profile[start : stop + 1]) for start, stop in _find_convex_runs(profile))
    return Solid(_revolve_outline(outline), pieces)


def make_shell(outer: Profile, inner: Profile) -> Solid:
    """Make a vessel of revolution: a floor between the first points, a wall along both profiles, which run abreast.

    The wall becomes `WEDGES` convex bodies per step of the profiles, so the cavity stays open.
    """
    outline = np.vstack([[0.0, outer[0, 1]], outer, inner[::-1], [0.0, inner[0, 1]]])
    step = SEGMENTS // WEDGES
    # The wall starts a hair above the foot, so that only the floor, not sixteen wedges, touches what it stands on.
    lifted = outer[0] + (outer[1] - outer[0]) * min(0.5, WALL_LIFT_M / (outer[1, 1] - outer[0, 1]))
    floor = _revolve_profile(np.stack([outer[0], lifted, inner[0]]))
    outer = np.vstack([lifted, outer[1:]])
    walls = []
    for k in range(len(outer) - 1):
        section = np.stack([outer[k], outer[k + 1], inner[k], inner[k + 1]])
        for wedge in range(WEDGES):
            angles = 2 * np.pi * np.arange(wedge * step, (wedge + 1) * step + 1) / SEGMENTS
            walls.append(_revolve_points(section, angles))
    return Solid(_revolve_outline(outline), (floor, *walls))


def make_loft(rings: Rings, stride: int = 1) -> Solid:
    """Make a tube with flat ends through rings, with a convex piece per `stride` steps."""
    count, around = rings.shape[:2]
    index = np.arange(count * around).reshape(count, around)
    a, b = index[:-1], index[1:]
    a_next, b_next = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    sides = [np.stack(corners, -1).reshape(-1, 3) for corners in ((a, a_next, b_next), (a, b_next, b))]
    first, last = count * around, count * around + 1
    bottom = np.stack([np.full(around, first), np.roll(index[0], -1), index[0]], axis=-1)
    top = np.stack([np.full(around, last), index[-1], np.roll(index[-1], -1)], axis=-1)
    vertices = np.vstack([rings.reshape(-1, 3), rings[0].mean(axis=0), rings[-1].mean(axis=0)])
    faces = np.concatenate([*sides, bottom, top])
    manifold = Manifold(Mesh64(vertices, faces.astype(np.uint64)))
    if manifold.volume() < 0.0:
        manifold = Manifold(Mesh64(vertices, faces[:, ::-1].astype(np.uint64)))
    pieces = (rings[start : min(start + stride, count - 1) + 1].reshape(-1, 3) for start in range(0, count - 1, stride))
    return Solid(manifold, tuple(pieces))


def make_tube(
    centers: Points, radii_uv: Float64[np.ndarray, "k 2"], normal: Sequence[float], around: int = 12
) -> Rings:
    """Make elliptic rings of `around` points about a planar curve, shape (k, 3) [m], whose plane has this unit normal.

    `radii_uv`, shape (k, 2), are the half widths along the normal, and across the curve in its plane [m].
    """
    tangents = np.gradient(centers, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    u = np.asarray(normal, dtype=np.float64)
    v = np.cross(tangents, u)
    angles = 2 * np.pi * (np.arange(around) + 0.5) / around
    circle_u, circle_v = np.cos(angles)[None, :, None], np.sin(angles)[None, :, None]
    along_u, along_v = radii_uv[:, 0, None, None] * circle_u * u, radii_uv[:, 1, None, None] * circle_v * v[:, None]
    return centers[:, None] + along_u + along_v


def _revolve_outline(outline: Profile) -> Manifold:
    distinct = np.linalg.norm(outline - np.roll(outline, 1, axis=0), axis=1) > 1e-7
    return Manifold.revolve(CrossSection([np.ascontiguousarray(outline[distinct])]), SEGMENTS)


def _revolve_profile(profile: Profile) -> Points:
    return _revolve_points(profile, 2 * np.pi * np.arange(SEGMENTS) / SEGMENTS)


def _revolve_points(section: Profile, angles: np.ndarray) -> Points:
    radius, height = section[:, :1], section[:, 1:]
    z = np.broadcast_to(height, (len(section), len(angles)))
    return np.stack([radius * np.cos(angles), radius * np.sin(angles), z], -1).reshape(-1, 3)


def _find_convex_runs(profile: Profile) -> list[tuple[int, int]]:
    """Find the index ranges over which a profile is convex, in order, sharing their ends."""
    steps = np.diff(profile, axis=0)
    turns = steps[:-1, 0] * steps[1:, 1] - steps[:-1, 1] * steps[1:, 0]
    cuts = [0, *(np.flatnonzero(turns < -1e-12) + 1).tolist(), len(profile) - 1]
    return list(pairwise(cuts))


def _make_rounded_rectangle(size_x: float, size_y: float, corner: float) -> Float64[np.ndarray, "m 2"]:
    corner = min(corner, 0.49 * size_x, 0.49 * size_y)
    core = CrossSection.square((size_x - 2 * corner, size_y - 2 * corner), True)
    if corner > 0.0:
        core = core.offset(corner, JoinType.Round, 2.0, 24)
    return np.asarray(core.to_polygons()[0], dtype=np.float64)


def _make_axis_rotation(axis: int, angle: float) -> Float64[np.ndarray, "3 3"]:
    cos, sin = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    rotation = np.eye(3)
    rotation[i, i], rotation[i, j], rotation[j, i], rotation[j, j] = cos, -sin, sin, cos
    return rotation
