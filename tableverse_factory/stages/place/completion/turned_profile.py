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
    """Intersect the rays with a turned shape, seen from outside: the depths [m], `MISS_M` for a miss."""
    axes = rotation_matrix(profile.frame.quaternion_wxyz)
    origin, directions = (rays.eye - profile.frame.position) @ axes, axes.T @ rays.directions
    return np.minimum(_intersect_sides(origin, directions, profile), _intersect_levels(origin, directions, profile))


def _intersect_sides(origin: Vector3, directions: Float64[np.ndarray, "3 n"], profile: TurnedProfile) -> Depths:
    """Intersect rays with the cones of a profile's straight pieces: where they enter the body or leave the cavity."""
    heights, radii = profile.heights, profile.radii
    inner_heights, inner_radii = profile.inner_heights, profile.inner_radii
    low, high = (np.concatenate([heights[of], inner_heights[of]])[:, None] for of in (slice(None, -1), slice(1, None)))
    start, end = (np.concatenate([radii[of], inner_radii[of]])[:, None] for of in (slice(None, -1), slice(1, None)))
    # Of the two roots of a cone, where the ray comes from outside, and where it comes from inside
    side = np.full(low.shape, -1.0)
    side[len(heights) - 1 :] = 1.0
    slope = (end - start) / (high - low)
    here = start + slope * (origin[2] - low)
    dx, dy, dz = directions
    narrowing = slope * dz
    a = dx * dx + dy * dy - narrowing * narrowing
    b = origin[0] * dx + origin[1] * dy - narrowing * here
    c = origin[0] ** 2 + origin[1] ** 2 - here * here
    with np.errstate(divide="ignore", invalid="ignore"):  # a ray that misses a cone, or runs along it, is not below
        t = (side * np.sqrt(b * b - a * c) - b) / a
        z = origin[2] + t * dz
    return np.where((t > 0.0) & (z >= low) & (z <= high), t, MISS_M).min(axis=0)


def _intersect_levels(origin: Vector3, directions: Float64[np.ndarray, "3 n"], profile: TurnedProfile) -> Depths:
    """Intersect rays with the base, the lid or rim, and the floor of a cavity."""
    rings = [(0.0, 0.0, profile.radii[0]), (profile.heights[-1], 0.0, profile.radii[-1])]
    if len(profile.inner_heights):
        rings[1] = (profile.heights[-1], profile.inner_radii[-1], profile.radii[-1])
        rings.append((profile.inner_heights[0], 0.0, profile.inner_radii[0]))
    height, least, most = np.array(rings).T[:, :, None]
    dx, dy, dz = directions
    t = (height - origin[2]) / np.where(np.abs(dz) < 1e-12, 1e-12, dz)
    x, y = origin[0] + t * dx, origin[1] + t * dy
    across = x * x + y * y
    return np.where((t > 0.0) & (across >= least * least) & (across <= most * most), t, MISS_M).min(axis=0)


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
