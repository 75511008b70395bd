"""Turned shapes of few numbers, for depth that a model estimated: an upright profile of six radii, solid or hollow.

Estimated depth is bent by more than a wall is thick, so that nothing can be carved by it. The silhouette is not: a shape
of few numbers that has it, stands on its support and follows the depth roughly is nearer to the truth than what the
depth shows. What another object hides goes on around the axis.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64
from manifold3d import CrossSection, FillRule, Manifold
from scipy.interpolate import PchipInterpolator
from scipy.optimize import minimize

from schemas.geometry import Frozen, Pose, TriangleMesh, Vector3
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.planes import fit_min_rectangle
from tableverse_factory.geometry.math.transforms import quaternion_about_z
from tableverse_factory.geometry.mesh.voxel_solids import from_manifold
from tableverse_factory.stages.place.completion.ray_misfit import MISS_M, Depths, RaySample, compute_misfit
from tableverse_factory.stages.place.view.object_view import ObjectView

KNOTS = 6
SEGMENTS = 48
RADIUS_RANGE_M, HEIGHT_RANGE_M = (0.003, 0.4), (0.004, 0.6)
WALL_SHARE, WALL_RANGE_M = 0.06, (0.0025, 0.006)  # thickness of a wall, as a share of the widest radius, and [m]
MIN_HOLLOW = 0.25  # least depth of a cavity, as a share of the height
BEND_M = 3e-4  # cost of bends of the profile by its widest radius [m]: it decides what was not seen
CARRY_WEIGHT = 0.1  # weight of how far outside of the body stands what it carries
CALLS, REFINING_CALLS = 70, 320  # of the search for the size of a template, and for all radii
HOPELESS_M = 1e-3  # cost over the best template's from which a template is not refined [m]
# Radii at the knots as shares of the widest, of which one is the start: a can, a ball, a cone; a beaker, a cup, a bowl
# and a dish.
SOLID = ((1.0,) * 6, (0.3, 0.62, 0.97, 0.97, 0.62, 0.25), (1.0, 0.97, 0.85, 0.65, 0.47, 0.4))
HOLLOW = ((1.0,) * 6, (0.7, 0.75, 0.83, 0.91, 0.98, 1.0), (0.4, 0.55, 0.76, 0.9, 0.98, 1.0), (0.62, 0.68, 0.78, 0.9, 0.98, 1.0))
FLOORS = (0.15, 0.5)  # of a cavity at the start, as shares of the height
FLAT_RINGS = 6  # of a level floor or lid
SMOOTH_STEPS = 4  # of the mesh between two knots

# Heights of the knots as shares of the whole: denser at the ends, where a ball closes.
_LEVELS = (1.0 - np.cos(np.linspace(0.0, np.pi, KNOTS))) / 2.0

Radii = Float64[np.ndarray, " k"]
# Middle x and y, logarithms of height and radii, and the height of a cavity's floor as a share of the whole.
Numbers = Float64[np.ndarray, " n"]


@dataclass(frozen=True, slots=True, eq=False)
class TurnedProfile(Frozen):
    """A profile about an upright axis: heights above the support and radii, and the same of its cavity, if any [m]."""

    center: Float64[np.ndarray, "2"]
    support_z: float
    heights: Radii
    radii: Radii
    inner_heights: Radii
    inner_radii: Radii


class TurnedShape(NamedTuple):
    """A profile and its misfit to the picture [m]."""

    profile: TurnedProfile
    misfit: float


def fit_turned(view: ObjectView, rays: RaySample) -> TurnedShape:
    """Fit the best turned shape that stands on the object's support, solid or hollow.

    Raises:
        GeometryError: if too little was seen to start from.
    """
    if len(view.points) < KNOTS:
        raise GeometryError("too few points for a turned shape")
    found = []
    for hollow, templates in ((False, SOLID), (True, HOLLOW)):
        sized = [_fit_size(view, rays, np.log(np.array(template)), hollow) for template in templates]
        cost, x = min(sized, key=lambda entry: entry[0])
        found.append((cost, hollow, x))
    least = min(cost for cost, *_ in found)
    shapes = [_refine(view, rays, x, hollow) for cost, hollow, x in found if cost < least + HOPELESS_M]
    return min(shapes, key=lambda shape: shape.misfit)


def build_turned_mesh(profile: TurnedProfile) -> tuple[TriangleMesh, Pose]:
    """Build the closed mesh about the middle of its box, and its pose in the table frame."""
    height = float(profile.heights[-1])
    section = _build_section(profile.heights, profile.radii)
    if len(profile.inner_heights):
        hole = _build_section(profile.inner_heights, profile.inner_radii)
        radius = float(profile.inner_radii[-1])
        mouth = np.array([[-radius, height - 1e-6], [radius, height - 1e-6], [radius, 2 * height], [-radius, 2 * height]])
        section = section - (hole + CrossSection([mouth], FillRule.NonZero))
    mesh = from_manifold(Manifold.revolve(section, SEGMENTS))
    middle = np.array([0.0, 0.0, height / 2])
    pose = Pose(np.array([*profile.center, profile.support_z + height / 2]), quaternion_about_z(0.0))
    return TriangleMesh(mesh.vertices - middle, mesh.faces), pose


def intersect_turned(rays: RaySample, profile: TurnedProfile) -> Depths:
    """Intersect the rays with a turned shape: the depths [m], `MISS_M` for a miss."""
    origin = rays.eye - np.array([*profile.center, profile.support_z])
    hit = _intersect_cones(origin, rays.directions, profile.heights, profile.radii)
    discs = [(0.0, 0.0, profile.radii[0]), (float(profile.heights[-1]), 0.0, profile.radii[-1])]
    if len(profile.inner_heights):
        hit = np.minimum(
            hit, _intersect_cones(origin, rays.directions, profile.inner_heights, profile.inner_radii)
        )
        discs[1] = (discs[1][0], profile.inner_radii[-1], profile.radii[-1])
        discs.append((float(profile.inner_heights[0]), 0.0, profile.inner_radii[0]))
    for height, least, most in discs:
        hit = np.minimum(hit, _intersect_ring(origin, rays.directions, height, float(least), float(most)))
    return hit


def _propose_centers(view: ObjectView) -> list[Float64[np.ndarray, "2"]]:
    """Propose axes: the middle of what was seen, and places behind it, for what shows its front alone."""
    rectangle = fit_min_rectangle(view.points[:, :2])
    away = rectangle.center - view.eye[:2]
    away = away / max(float(np.linalg.norm(away)), 1e-9)
    reach = float(np.max(rectangle.half_size))
    short = float(np.min(rectangle.half_size))
    return [rectangle.center, rectangle.center + away * (reach - short), rectangle.center + 0.5 * away * reach]


def _fit_size(view: ObjectView, rays: RaySample, template: Radii, hollow: bool) -> tuple[float, Numbers]:
    """Fit place and size of a template; returns its cost [m] and all numbers of the shape."""
    height = max(float(np.quantile(view.points[:, 2], 0.98)) - view.support_z, 2 * HEIGHT_RANGE_M[0])
    radius = float(np.clip(np.max(fit_min_rectangle(view.points[:, :2]).half_size), 2 * RADIUS_RANGE_M[0], None))

    def unfold(x: Numbers) -> Numbers:
        return np.concatenate([x[:3], x[3] + template, x[4:]])

    def cost(x: Numbers) -> float:
        return _measure_cost(view, rays, unfold(x), hollow)[0]

    floors: tuple[tuple[float, ...], ...] = tuple((floor,) for floor in FLOORS) if hollow else ((),)
    starts = [
        np.array([*center, np.log(height), np.log(radius), *floor])
        for center in _propose_centers(view)
        for floor in floors
    ]
    start = min(starts, key=cost)
    steps = np.array([0.2 * radius, 0.2 * radius, -0.2, -0.15, 0.25])[: len(start)]
    found = _minimize(cost, start, steps, CALLS)
    return cost(found), unfold(found)


def _refine(view: ObjectView, rays: RaySample, start: Numbers, hollow: bool) -> TurnedShape:
    """Fit all numbers of a shape."""
    size = float(np.exp(start[3 : 3 + KNOTS]).max())
    steps = np.array([0.06 * size, 0.06 * size, 0.06, *([0.08] * KNOTS), 0.1])[: len(start)]
    found = _minimize(lambda x: _measure_cost(view, rays, x, hollow)[0], start, steps, REFINING_CALLS)
    cost, profile = _measure_cost(view, rays, found, hollow)
    return TurnedShape(profile, cost)


def _minimize(cost: Callable[[Numbers], float], start: Numbers, steps: Numbers, calls: int) -> Numbers:
    simplex = np.vstack([start, start + np.diag(steps)])
    options = {"initial_simplex": simplex, "maxfev": calls, "xatol": 2e-4, "fatol": 2e-6, "adaptive": len(start) > 5}
    return np.asarray(minimize(cost, start, method="Nelder-Mead", options=options).x)


def _measure_cost(
    view: ObjectView, rays: RaySample, x: Numbers, hollow: bool
) -> tuple[float, TurnedProfile]:
    profile = _decode(view, x, hollow)
    bends = float(np.abs(np.diff(profile.radii, 2)).sum() / profile.radii.max())
    cost = compute_misfit(rays, intersect_turned(rays, profile)) + BEND_M * bends
    carried = view.support.carried
    if len(carried):
        outside = np.linalg.norm(carried - profile.center, axis=1) - float(profile.radii.max())
        cost += CARRY_WEIGHT * float(np.maximum(outside, 0.0).mean())
    return cost, profile


def _decode(view: ObjectView, x: Numbers, hollow: bool) -> TurnedProfile:
    height = float(np.clip(np.exp(x[2]), *HEIGHT_RANGE_M))
    radii = np.clip(np.exp(x[3 : 3 + KNOTS]), *RADIUS_RANGE_M)
    heights = height * _LEVELS
    none = np.zeros(0)
    inner_heights, inner_radii = none, none
    if hollow:
        wall = float(np.clip(WALL_SHARE * radii.max(), *WALL_RANGE_M))
        slope = np.gradient(radii, heights)
        inner = radii - wall * np.hypot(1.0, slope)
        share = float(np.clip(x[3 + KNOTS], 0.0, 1.0 - MIN_HOLLOW))
        floor = max(share * height, min(wall, 0.5 * height))
        above = heights > floor + 1e-6
        inner_heights = np.concatenate([[floor], heights[above]])
        inner_radii = np.concatenate([[np.interp(floor, heights, inner)], inner[above]])
        inner_radii = np.clip(inner_radii, 1e-3, None)
        # The rim keeps a wall however steep the profile opens, and the cavity stays within the body.
        inner_radii = np.minimum(inner_radii, np.interp(inner_heights, heights, radii) - min(wall, 0.4 * radii.min()))
    return TurnedProfile(x[:2].copy(), view.support_z, heights, radii, inner_heights, inner_radii)


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
        on = (inside >= 0.0) & (t > 0.0) & (z >= heights[:-1, None]) & (z <= heights[1:, None]) & (base + slope * z >= 0)
        hit = np.minimum(hit, np.where(on, t, MISS_M).min(axis=0))
    return hit


def _intersect_ring(
    origin: Vector3, directions: Float64[np.ndarray, "3 n"], height: float, least: float, most: float
) -> Depths:
    dz = np.where(np.abs(directions[2]) < 1e-12, 1e-12, directions[2])
    t = (height - origin[2]) / dz
    across = np.hypot(origin[0] + t * directions[0], origin[1] + t * directions[1])
    return np.where((t > 0.0) & (across >= least) & (across <= most), t, MISS_M)


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
