"""Profiles of turned shapes: their solids, and where rays meet them."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from manifold3d import CrossSection, FillRule, JoinType, Manifold
from scipy.interpolate import PchipInterpolator

from schemas.geometry import Frozen, Pose, Vector3
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.stages.place.completion.ray_misfit import MISS_M, Depths, RaySample

SEGMENTS = 48
FLAT_RINGS = 6  # of a level floor or lid
SMOOTH_STEPS = 4  # of the mesh between two knots
LEAST_WALL_M = 0.0012

Radii = Float64[np.ndarray, " k"]


@dataclass(frozen=True, slots=True, eq=False)
class TurnedProfile(Frozen):
    """A profile about an axis: heights along it and radii, and the same of its cavity, if any [m].

    `frame` has its origin at the height 0 and z along the axis, in the table frame.
    """

    frame: Pose
    heights: Radii
    radii: Radii
    inner_heights: Radii
    inner_radii: Radii


def build_turned_solid(profile: TurnedProfile) -> tuple[Manifold, Manifold | None]:
    """Build the solid, and its cavity if it has one, in the frame of the profile."""
    height = float(profile.heights[-1])
    section, cavity = _build_section(profile.heights, profile.radii), None
    if len(profile.inner_heights):
        hole = _build_section(profile.inner_heights, profile.inner_radii)
        hole = hole + _build_mouth(float(profile.inner_radii[-1]), height)
        # Between knots the rounded cavity must not pierce the rounded body.
        within = (section + _build_mouth(float(profile.radii[-1]), height)).offset(-LEAST_WALL_M, JoinType.Round)
        hole = max((hole ^ within).decompose(), key=lambda part: part.area())
        section, cavity = section - hole, Manifold.revolve(hole, SEGMENTS)
    return Manifold.revolve(section, SEGMENTS), cavity


def intersect_turned(rays: RaySample, profile: TurnedProfile) -> Depths:
    """Intersect the rays with a turned shape: the depths [m], `MISS_M` for a miss."""
    axes = rotation_matrix(profile.frame.quaternion_wxyz)
    origin, directions = (rays.eye - profile.frame.position) @ axes, axes.T @ rays.directions
    hit = _intersect_cones(origin, directions, profile.heights, profile.radii)
    discs = [(0.0, 0.0, profile.radii[0]), (float(profile.heights[-1]), 0.0, profile.radii[-1])]
    if len(profile.inner_heights):
        hit = np.minimum(hit, _intersect_cones(origin, directions, profile.inner_heights, profile.inner_radii))
        discs[1] = (discs[1][0], profile.inner_radii[-1], profile.radii[-1])
        discs.append((float(profile.inner_heights[0]), 0.0, profile.inner_radii[0]))
    for height, least, most in discs:
        hit = np.minimum(hit, _intersect_ring(origin, directions, height, float(least), float(most)))
    return hit


def _intersect_cones(origin: Vector3, directions: Float64[np.ndarray, "3 n"], heights: Radii, radii: Radii) -> Depths:
    """Intersect rays with the sides of a profile of straight pieces."""
    slope = np.diff(radii) / np.diff(heights)
    base = (radii[:-1] - slope * heights[:-1])[:, None]
    slope = slope[:, None]
    dx, dy, dz = directions
    ox, oy, oz = (float(v) for v in origin)
    here = base + slope * oz
    a = dx * dx + dy * dy - (slope * dz) ** 2
    b = ox * dx + oy * dy - slope * dz * here
    c = ox * ox + oy * oy - here * here
    a = np.where(np.abs(a) < 1e-12, 1e-12, a)
    inside = b * b - a * c
    root = np.sqrt(np.maximum(inside, 0.0))
    hit = np.full(directions.shape[1], MISS_M)
    for t in ((-b - root) / a, (-b + root) / a):
        z = oz + t * dz
        on = (
            (inside >= 0.0) & (t > 0.0) & (z >= heights[:-1, None]) & (z <= heights[1:, None]) & (base + slope * z >= 0)
        )
        hit = np.minimum(hit, np.where(on, t, MISS_M).min(axis=0))
    return hit


def _intersect_ring(
    origin: Vector3, directions: Float64[np.ndarray, "3 n"], height: float, least: float, most: float
) -> Depths:
    dz = np.where(np.abs(directions[2]) < 1e-12, 1e-12, directions[2])
    t = (height - origin[2]) / dz
    across = np.hypot(origin[0] + t * directions[0], origin[1] + t * directions[1])
    return np.where((t > 0.0) & (across >= least) & (across <= most), t, MISS_M)


def _build_mouth(radius: float, height: float) -> CrossSection:
    """Build the space above a height, as high again."""
    low = height - 1e-6
    corners = np.array([[-radius, low], [radius, low], [radius, 2 * height], [-radius, 2 * height]])
    return CrossSection([corners], FillRule.NonZero)


def _build_section(heights: Radii, radii: Radii) -> CrossSection:
    heights, radii = _smooth(heights, radii)
    inner = np.linspace(0.0, 1.0, FLAT_RINGS + 1)[1:-1]  # vertex colours show nothing between two vertices
    radii = np.concatenate([inner * radii[0], radii, inner[::-1] * radii[-1]])
    heights = np.concatenate([np.full(len(inner), heights[0]), heights, np.full(len(inner), heights[-1])])
    right = np.stack([radii, heights], axis=1)
    left = right[::-1] * np.array([-1.0, 1.0])
    return CrossSection([np.concatenate([right, left])], FillRule.NonZero)


def _smooth(heights: Radii, radii: Radii) -> tuple[Radii, Radii]:
    """Round a profile between its knots, without new bumps."""
    if len(heights) < 3:
        return heights, radii
    places = np.arange(len(heights), dtype=np.float64)
    fine = np.linspace(0.0, places[-1], SMOOTH_STEPS * (len(heights) - 1) + 1)
    return PchipInterpolator(places, heights)(fine), PchipInterpolator(places, radii)(fine)
