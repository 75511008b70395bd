"""Turned shapes of few numbers, for depth that a model estimated: a profile of six radii, solid or hollow.

Estimated depth is bent by more than a wall is thick, so that nothing can be carved by it. The silhouette is not: a
shape of few numbers that has it, rests on its support and follows the depth roughly is nearer to the truth than what
the depth shows. What another object hides goes on around the axis.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float64
from manifold3d import CrossSection, FillRule, Manifold
from scipy.interpolate import PchipInterpolator
from scipy.optimize import minimize

from schemas.geometry import Frozen, Pose, TriangleMesh, Vector3
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.planes import fit_min_rectangle
from tableverse_factory.geometry.math.transforms import (
    quaternion_about_z,
    quaternion_from_matrix,
    rotation_matrix,
    transform_points,
)
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
STANDING = ((1.0,) * 6, (0.3, 0.62, 0.97, 0.97, 0.62, 0.25), (1.0, 0.97, 0.85, 0.65, 0.47, 0.4))
HOLLOW = (
    (1.0,) * 6,
    (0.7, 0.75, 0.83, 0.91, 0.98, 1.0),
    (0.4, 0.55, 0.76, 0.9, 0.98, 1.0),
    (0.62, 0.68, 0.78, 0.9, 0.98, 1.0),
)
LYING = (
    (1.0,) * 6,
    (0.3, 0.62, 0.97, 0.97, 0.62, 0.25),
    (0.3, 0.7, 1.0, 0.8, 0.5, 0.3),
    (0.3, 0.5, 0.8, 1.0, 0.7, 0.3),
)
LONG = 1.15  # least length over breadth of what may lie
FLOORS = (0.15, 0.5)  # of a cavity at the start, as shares of the height
FLAT_RINGS = 6  # of a level floor or lid
SMOOTH_STEPS = 4  # of the mesh between two knots

# Heights of the knots as shares of the whole: denser at the ends, where a ball closes.
_LEVELS = (1.0 - np.cos(np.linspace(0.0, np.pi, KNOTS))) / 2.0

Radii = Float64[np.ndarray, " k"]
Kind = Literal["solid", "hollow", "lying"]
# Middle x and y, logarithms of height and radii; then the height of a cavity's floor as a share of the whole, or the
# heading of what lies.
Numbers = Float64[np.ndarray, " n"]


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


class TurnedShape(NamedTuple):
    """A profile and its misfit to the picture [m]."""

    profile: TurnedProfile
    misfit: float


def fit_standing(view: ObjectView, rays: RaySample) -> TurnedShape:
    """Fit the best turned shape that stands on the object's support, solid or hollow.

    Raises:
        GeometryError: if too little was seen to start from.
    """
    if len(view.points) < KNOTS:
        raise GeometryError("too few points for a turned shape")
    return _fit_best(view, rays, (("solid", STANDING), ("hollow", HOLLOW)))


def fit_lying(view: ObjectView, rays: RaySample) -> TurnedShape | None:
    """Fit the best turned shape that lies on the object's support; None for what is not long.

    Raises:
        GeometryError: if too little was seen to start from.
    """
    if len(view.points) < KNOTS:
        raise GeometryError("too few points for a turned shape")
    half = fit_min_rectangle(view.points[:, :2]).half_size
    return _fit_best(view, rays, (("lying", LYING),)) if max(half) > LONG * min(half) else None


def _fit_best(
    view: ObjectView, rays: RaySample, kinds: tuple[tuple[Kind, tuple[tuple[float, ...], ...]], ...]
) -> TurnedShape:
    found = []
    for kind, templates in kinds:
        sized = [_fit_size(view, rays, np.log(np.array(template)), kind) for template in templates]
        cost, x = min(sized, key=lambda entry: entry[0])
        found.append((cost, kind, x))
    least = min(cost for cost, *_ in found)
    shapes = [_refine(view, rays, x, kind) for cost, kind, x in found if cost < least + HOPELESS_M]
    return min(shapes, key=lambda shape: shape.misfit)


def build_turned_mesh(profile: TurnedProfile) -> tuple[TriangleMesh, Pose]:
    """Build the closed mesh about the middle of its box, and its pose in the table frame."""
    height = float(profile.heights[-1])
    section = _build_section(profile.heights, profile.radii)
    if len(profile.inner_heights):
        hole = _build_section(profile.inner_heights, profile.inner_radii)
        radius = float(profile.inner_radii[-1])
        mouth = np.array(
            [[-radius, height - 1e-6], [radius, height - 1e-6], [radius, 2 * height], [-radius, 2 * height]]
        )
        section = section - (hole + CrossSection([mouth], FillRule.NonZero))
    mesh = from_manifold(Manifold.revolve(section, SEGMENTS))
    middle = np.array([0.0, 0.0, height / 2])
    pose = Pose(transform_points(profile.frame, middle[None])[0], profile.frame.quaternion_wxyz)
    return TriangleMesh(mesh.vertices - middle, mesh.faces), pose


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


def _propose_centers(view: ObjectView) -> list[Float64[np.ndarray, "2"]]:
    """Propose axes: the middle of what was seen, and places behind it, for what shows its front alone."""
    rectangle = fit_min_rectangle(view.points[:, :2])
    away = rectangle.center - view.eye[:2]
    away = away / max(float(np.linalg.norm(away)), 1e-9)
    reach = float(np.max(rectangle.half_size))
    short = float(np.min(rectangle.half_size))
    return [rectangle.center, rectangle.center + away * (reach - short), rectangle.center + 0.5 * away * reach]


def _fit_size(view: ObjectView, rays: RaySample, template: Radii, kind: Kind) -> tuple[float, Numbers]:
    """Fit place and size of a template; returns its cost [m] and all numbers of the shape."""
    height = max(float(np.quantile(view.points[:, 2], 0.98)) - view.support_z, 2 * HEIGHT_RANGE_M[0])
    footprint = fit_min_rectangle(view.points[:, :2])
    short, long = np.clip(np.sort(footprint.half_size), 2 * RADIUS_RANGE_M[0], None)
    size = (2 * long, short) if kind == "lying" else (height, long)
    radius = float(size[1])
    last: tuple[tuple[float, ...], ...] = ((),)
    if kind == "hollow":
        last = tuple((floor,) for floor in FLOORS)
    elif kind == "lying":
        last = ((footprint.yaw + (np.pi / 2 if footprint.half_size[1] > footprint.half_size[0] else 0.0),),)

    def unfold(x: Numbers) -> Numbers:
        return np.concatenate([x[:3], x[3] + template, x[4:]])

    def cost(x: Numbers) -> float:
        return _measure_cost(view, rays, unfold(x), kind)[0]

    starts = [np.array([*center, *np.log(size), *number]) for center in _propose_centers(view) for number in last]
    start = min(starts, key=cost)
    steps = np.array([0.2 * radius, 0.2 * radius, -0.2, -0.15, 0.25])[: len(start)]
    found = _minimize(cost, start, steps, CALLS)
    return cost(found), unfold(found)


def _refine(view: ObjectView, rays: RaySample, start: Numbers, kind: Kind) -> TurnedShape:
    """Fit all numbers of a shape."""
    size = float(np.exp(start[3 : 3 + KNOTS]).max())
    steps = np.array([0.06 * size, 0.06 * size, 0.06, *([0.08] * KNOTS), 0.1])[: len(start)]
    found = _minimize(lambda x: _measure_cost(view, rays, x, kind)[0], start, steps, REFINING_CALLS)
    cost, profile = _measure_cost(view, rays, found, kind)
    return TurnedShape(profile, cost)


def _minimize(cost: Callable[[Numbers], float], start: Numbers, steps: Numbers, calls: int) -> Numbers:
    simplex = np.vstack([start, start + np.diag(steps)])
    options = {"initial_simplex": simplex, "maxfev": calls, "xatol": 2e-4, "fatol": 2e-6, "adaptive": len(start) > 5}
    return np.asarray(minimize(cost, start, method="Nelder-Mead", options=options).x)


def _measure_cost(view: ObjectView, rays: RaySample, x: Numbers, kind: Kind) -> tuple[float, TurnedProfile]:
    profile = _decode(view, x, kind)
    bends = float(np.abs(np.diff(profile.radii, 2)).sum() / profile.radii.max())
    cost = compute_misfit(rays, intersect_turned(rays, profile)) + BEND_M * bends
    carried = view.support.carried
    if len(carried) and kind != "lying":
        outside = np.linalg.norm(carried - profile.frame.position[:2], axis=1) - float(profile.radii.max())
        cost += CARRY_WEIGHT * float(np.maximum(outside, 0.0).mean())
    return cost, profile


def _decode(view: ObjectView, x: Numbers, kind: Kind) -> TurnedProfile:
    height = float(np.clip(np.exp(x[2]), *HEIGHT_RANGE_M))
    radii = np.clip(np.exp(x[3 : 3 + KNOTS]), *RADIUS_RANGE_M)
    heights = height * _LEVELS
    inner = np.zeros(0), np.zeros(0)
    if kind == "lying":
        along = np.array([np.cos(x[-1]), np.sin(x[-1]), 0.0])
        start = np.array([*x[:2], view.support_z + float(radii.max())]) - along * height / 2
        axes = np.stack([np.array([-along[1], along[0], 0.0]), np.array([0.0, 0.0, 1.0]), along], axis=1)
        return TurnedProfile(Pose(start, quaternion_from_matrix(axes)), heights, radii, *inner)
    if kind == "hollow":
        inner = _build_cavity(heights, radii, float(x[-1]))
    return TurnedProfile(Pose(np.array([*x[:2], view.support_z]), quaternion_about_z(0.0)), heights, radii, *inner)


def _build_cavity(heights: Radii, radii: Radii, floor_share: float) -> tuple[Radii, Radii]:
    """Build heights and radii of a cavity within a wall, down to a floor at a share of the height."""
    wall = float(np.clip(WALL_SHARE * radii.max(), *WALL_RANGE_M))
    inner = radii - wall * np.hypot(1.0, np.gradient(radii, heights))
    height = float(heights[-1])
    floor = max(float(np.clip(floor_share, 0.0, 1.0 - MIN_HOLLOW)) * height, min(wall, 0.5 * height))
    above = heights > floor + 1e-6
    at = np.concatenate([[floor], heights[above]])
    found = np.maximum(np.concatenate([[np.interp(floor, heights, inner)], inner[above]]), 1e-3)
    # The rim keeps a wall however steeply the profile opens.
    return at, np.minimum(found, np.interp(at, heights, radii) - min(wall, 0.4 * float(radii.min())))


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
