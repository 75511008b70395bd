"""Turned shapes of few numbers, for depth that is wrong or estimated: a profile of six radii, solid or hollow.

Estimated depth is bent by more than a wall is thick, so that nothing can be carved by it. The silhouette is not: a
shape of few numbers that has it, rests on its support and follows the depth roughly is nearer to the truth than what
the depth shows. What another object hides goes on around the axis.
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Pose
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.planes import Rectangle, fit_min_rectangle
from tableverse_factory.geometry.math.transforms import (
    quaternion_about_z,
    quaternion_from_matrix,
)
from tableverse_factory.stages.place.completion.nelder_mead import minimize_cost
from tableverse_factory.stages.place.completion.ray_misfit import MISS_M, RaySample, compute_misfit
from tableverse_factory.stages.place.completion.turned_profile import Radii, TurnedProfile, intersect_turned
from tableverse_factory.stages.place.view.object_view import ObjectView

KNOTS = 6
RADIUS_RANGE_M, HEIGHT_RANGE_M = (0.003, 0.4), (0.004, 0.6)
WALL_SHARE, WALL_RANGE_M = 0.06, (0.0025, 0.006)  # thickness of a wall, as a share of the widest radius, and [m]
MIN_HOLLOW = 0.25  # least depth of a cavity, as a share of the height
BEND_M = 3e-4  # cost of bends of the profile by its widest radius [m]: it decides what was not seen
CARRY_WEIGHT = 0.1  # weight of how far outside of the body stands what it carries
CALLS, REFINING_CALLS = 70, 320  # of the search for the size of a template, and for all radii
FATOL_M = 2e-6  # differences of cost at which a search ends [m]
HOPELESS_M = 1e-3  # cost over the best template's from which a template is not refined [m]
MOST_REFINED_M = 1.5e-3  # gain to expect by all radii [m]: of 112 selected shapes under 1.3 mm of 95 %, at most 2.6
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
SHOWN_INSIDE = 0.15  # least share of the object's rays that must show a cavity's inside
LONG = 1.15  # least length over breadth of what may lie
FLOORS = (0.15, 0.5)  # of a cavity at the start, as shares of the height

# Heights of the knots as shares of the whole: denser at the ends, where a ball closes.
_LEVELS = (1.0 - np.cos(np.linspace(0.0, np.pi, KNOTS))) / 2.0
# Matrix (knots, knots) of the gradient of values at the knots, over the height: `np.gradient` costs more than all rays
_GRADIENT = np.gradient(np.eye(KNOTS), _LEVELS, axis=0)

Kind = Literal["solid", "hollow", "lying"]
KindTemplates = tuple[Kind, tuple[tuple[float, ...], ...]]
STANDING_KINDS: tuple[KindTemplates, KindTemplates] = (("solid", STANDING), ("hollow", HOLLOW))
# Middle x and y, logarithms of height and radii; then the height of a cavity's floor as a share of the whole, or the
# heading of what lies.
Numbers = Float64[np.ndarray, " n"]


class TurnedShape(NamedTuple):
    """A profile and its misfit to the picture [m]."""

    profile: TurnedProfile
    misfit: float


class TurnedFit(NamedTuple):
    """Templates at their best sizes: the least misfit to expect of a shape of theirs [m], and how to fit all radii."""

    least: float
    finish: Callable[[], TurnedShape]


def fit_standing(view: ObjectView, rays: RaySample) -> TurnedFit:
    """Fit the best turned shape that stands on the object's support, solid or hollow.

    Raises:
        GeometryError: if too little was seen to start from.
    """
    return _fit_best(view, rays, _measure_footprint(view), STANDING_KINDS)


def fit_solid(view: ObjectView, rays: RaySample) -> TurnedFit:
    """Fit the best turned solid that stands on the object's support; errors as of `fit_standing`."""
    return _fit_best(view, rays, _measure_footprint(view), STANDING_KINDS[:1])


def fit_vessel(view: ObjectView, rays: RaySample) -> TurnedFit | None:
    """Fit the best turned vessel that stands on the object's support.

    None where the best solid template fits as well as the best hollow one, at their best sizes.

    Raises:
        GeometryError: if too little was seen to start from; when finished, if the object's rays do not meet the cavity.
    """
    footprint = _measure_footprint(view)
    (_, solid, _), (kind, hollow, x) = (_find_template(view, rays, footprint, *each) for each in STANDING_KINDS)
    if solid <= hollow:
        return None

    def finish() -> TurnedShape:
        shape = _refine(view, rays, x, kind)
        if not shows_cavity(rays, shape.profile):
            raise GeometryError("the picture does not show the cavity of a turned vessel")
        return shape

    return TurnedFit(hollow - MOST_REFINED_M, finish)


def shows_cavity(rays: RaySample, profile: TurnedProfile) -> bool:
    """Whether the object's rays meet the inside of a cavity, and not by a few: what is hidden may have any."""
    if not len(profile.inner_heights):
        return False
    count = len(rays.facing)
    solid = replace(profile, inner_heights=np.zeros(0), inner_radii=np.zeros(0))
    met, lid = (intersect_turned(rays, shape)[:count] for shape in (profile, solid))
    return float(((rays.facing > 0.0) & (met < MISS_M) & (met > lid)).mean()) > SHOWN_INSIDE


def fit_lying(view: ObjectView, rays: RaySample) -> TurnedFit | None:
    """Fit the best turned shape that lies on the object's support; None for what is not long.

    Raises:
        GeometryError: if too little was seen to start from.
    """
    footprint = _measure_footprint(view)
    is_long = max(footprint.half_size) > LONG * min(footprint.half_size)
    return _fit_best(view, rays, footprint, (("lying", LYING),)) if is_long else None


def _measure_footprint(view: ObjectView) -> Rectangle:
    if len(view.points) < KNOTS:
        raise GeometryError("too few points for a turned shape")
    return fit_min_rectangle(view.points[:, :2])


def _fit_best(
    view: ObjectView,
    rays: RaySample,
    footprint: Rectangle,
    kinds: tuple[KindTemplates, ...],
) -> TurnedFit:
    found = [_find_template(view, rays, footprint, *each) for each in kinds]
    least = min(cost for _, cost, _ in found)

    def finish() -> TurnedShape:
        shapes = [_refine(view, rays, x, kind) for kind, cost, x in found if cost < least + HOPELESS_M]
        return min(shapes, key=lambda shape: shape.misfit)

    return TurnedFit(least - MOST_REFINED_M, finish)


def _find_template(
    view: ObjectView, rays: RaySample, footprint: Rectangle, kind: Kind, templates: tuple[tuple[float, ...], ...]
) -> tuple[Kind, float, Numbers]:
    """Find the best template of a kind at its best size; returns its cost [m] and all numbers of the shape."""
    sized = [_fit_size(view, rays, footprint, np.log(np.array(template)), kind) for template in templates]
    cost, x = min(sized, key=lambda entry: entry[0])
    return kind, cost, x


def _propose_centers(view: ObjectView, footprint: Rectangle) -> list[Float64[np.ndarray, "2"]]:
    """Propose axes: the middle of what was seen, and places behind it, for what shows its front alone."""
    away = footprint.center - view.eye[:2]
    away = away / max(float(np.linalg.norm(away)), 1e-9)
    reach = float(np.max(footprint.half_size))
    short = float(np.min(footprint.half_size))
    return [footprint.center, footprint.center + away * (reach - short), footprint.center + 0.5 * away * reach]


def _fit_size(
    view: ObjectView, rays: RaySample, footprint: Rectangle, template: Radii, kind: Kind
) -> tuple[float, Numbers]:
    """Fit place and size of a template; returns its cost [m] and all numbers of the shape."""
    height = max(float(np.quantile(view.points[:, 2], 0.98)) - view.support_z, 2 * HEIGHT_RANGE_M[0])
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

    starts = [
        np.array([*center, *np.log(size), *number]) for center in _propose_centers(view, footprint) for number in last
    ]
    start = min(starts, key=cost)
    steps = np.array([0.2 * radius, 0.2 * radius, -0.2, -0.15, 0.25])[: len(start)]
    found = minimize_cost(cost, start, steps, CALLS, fatol=FATOL_M)
    return cost(found), unfold(found)


def _refine(view: ObjectView, rays: RaySample, start: Numbers, kind: Kind) -> TurnedShape:
    """Fit all numbers of a shape."""
    size = float(np.exp(start[3 : 3 + KNOTS]).max())
    steps = np.array([0.06 * size, 0.06 * size, 0.06, *([0.08] * KNOTS), 0.1])[: len(start)]

    def measure(x: Numbers) -> float:
        return _measure_cost(view, rays, x, kind)[0]

    found = minimize_cost(measure, start, steps, REFINING_CALLS, fatol=FATOL_M, adaptive=True)
    cost, profile = _measure_cost(view, rays, found, kind)
    return TurnedShape(profile, cost)


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
        inner = _build_cavity(height, radii, float(x[-1]))
    return TurnedProfile(Pose(np.array([*x[:2], view.support_z]), quaternion_about_z(0.0)), heights, radii, *inner)


def _build_cavity(height: float, radii: Radii, floor_share: float) -> tuple[Radii, Radii]:
    """Build heights and radii of a cavity within a wall, down to a floor at a share of the height."""
    heights = height * _LEVELS
    wall = min(max(WALL_SHARE * float(radii.max()), WALL_RANGE_M[0]), WALL_RANGE_M[1])
    inner = radii - wall * np.hypot(1.0, _GRADIENT @ radii / height)
    floor = max(min(max(floor_share, 0.0), 1.0 - MIN_HOLLOW) * height, min(wall, 0.5 * height))
    above = heights > floor + 1e-6
    at = np.concatenate([[floor], heights[above]])
    found = np.maximum(np.concatenate([[np.interp(floor, heights, inner)], inner[above]]), 1e-3)
    # The rim keeps a wall however steeply the profile opens.
    return at, np.minimum(found, np.interp(at, heights, radii) - min(wall, 0.4 * float(radii.min())))
