"""Recipes for small groups of objects: alone, stacked, on a dish, filled, leaning, across an edge.

A recipe makes a group about its own origin on the table plane, without overlaps, ready to be dropped a little.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from schemas.geometry import Frozen, Points, Pose, Quaternion
from tableverse_factory.geometry.math.transforms import multiply_quaternions, quaternion_about_z, transform_points
from tableverse_factory.sources.synthetic.catalogue import CATEGORIES, Role, make_for_role
from tableverse_factory.sources.synthetic.model import GeneratedObject, GeneratorCavity

GAP_M = 0.0008
FOOT_M = 0.004  # Height of the part of an object that is its foot
TRIES = 12


@dataclass(frozen=True, slots=True, eq=False)
class PlacedModel(Frozen):
    """A generated object and its pose: its own frame to the group's or the table's."""

    model: GeneratedObject
    pose: Pose

    def vertices(self) -> Points:
        """Transform the vertices to the frame of the pose's parent [m]. Shape (n, 3)."""
        return transform_points(self.pose, self.model.mesh.vertices)


Recipe = Callable[[np.random.Generator], list[PlacedModel]]


def place_alone(rng: np.random.Generator) -> list[PlacedModel]:
    """Place any object by itself, some of them on their side."""
    categories = list(CATEGORIES.values())
    weights = np.array([category.weight for category in categories])
    category = categories[int(rng.choice(len(categories), p=weights / weights.sum()))]
    model = category.make(rng)
    lies = category.may_lie and rng.random() < 0.25
    return [stand_on(model, _make_rotation((1.0, 0.0, 0.0), np.pi / 2) if lies else _UPRIGHT)]


def stack_on_base(rng: np.random.Generator) -> list[PlacedModel]:
    """Stack one or two objects on a book or box, the smaller above."""
    group = [stand_on(make_for_role(rng, "base"), _UPRIGHT)]
    steps: tuple[tuple[Role, float], ...] = (("base", 0.45), ("rider", 1.0))
    for role, chance in steps:
        rider = _put_on_top(rng, role, group[-1]) if rng.random() < chance else None
        group += [] if rider is None else [rider]
    return group


def put_on_dish(rng: np.random.Generator) -> list[PlacedModel]:
    """Put a bowl, cup or small object on a plate."""
    dish = stand_on(make_for_role(rng, "dish"), _UPRIGHT)
    rider = _put_on_top(rng, "rider", dish)
    return [dish] if rider is None else [dish, rider]


def fill_container(rng: np.random.Generator) -> list[PlacedModel]:
    """Fill a bowl or pan with one to four objects."""
    vessel, cavity = _draw_container(rng, wide=True)
    group = [stand_on(vessel, _UPRIGHT)]
    count, first = int(rng.integers(1, 5)), rng.uniform(0.0, 2 * np.pi)
    height = cavity.rim
    for k in range(count):
        model = make_for_role(rng, "content")
        angle, radius = first + 2.4 * k, 0.0 if count == 1 else 0.35 * cavity.floor_radius
        place = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        placed = stand_on(model, quaternion_about_z(rng.uniform(0.0, 2 * np.pi)), place)
        group.append(placed)
        # Each starts above the one before it where the two would overlap, seen from above.
        height = placed.vertices()[:, 2].max() + 2 * GAP_M
    return group


def put_utensils_in(rng: np.random.Generator) -> list[PlacedModel]:
    """Put spoons, forks or pens into a mug or cup."""
    vessel, cavity = _draw_container(rng, wide=False)
    group = [stand_on(vessel, quaternion_about_z(rng.uniform(0.0, 2 * np.pi)))]
    count, first = int(rng.choice([1, 1, 2, 3])), rng.uniform(0.0, 2 * np.pi)
    for k in range(count):
        model = make_for_role(rng, "utensil")
        half = np.ptp(model.mesh.vertices, axis=0)[0] / 2
        head_down = count == 1 and rng.random() < 0.6
        azimuth = first + 2 * np.pi * k / count
        toward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        foot = (-0.15 if count == 1 else 0.55) * cavity.floor_radius
        lean = (0.55 if count == 1 else 0.75) * cavity.rim_radius
        slope = np.arctan2(lean - foot, cavity.rim - cavity.floor)
        upward = multiply_quaternions(_make_rotation((0.0, 0.0, 1.0), azimuth), _make_rotation((0.0, 1.0, 0.0), slope))
        # The utensil's +x end is its head: stood on it, or with the head up.
        rotation = multiply_quaternions(upward, _make_rotation((0.0, 1.0, 0.0), np.pi / 2 if head_down else -np.pi / 2))
        axis = transform_points(Pose(np.zeros(3), rotation), np.array([[-half if head_down else half, 0.0, 0.0]]))[0]
        place = toward * (foot + float(axis @ toward)) + [0.0, 0.0, cavity.floor]
        group.append(stand_on(model, rotation, place))
    return group


def lean_on_prop(rng: np.random.Generator) -> list[PlacedModel]:
    """Lean a book, box, phone or remote control on a taller object behind it."""
    for _ in range(TRIES):
        prop, leaner = make_for_role(rng, "prop"), make_for_role(rng, "leaner")
        extents = np.ptp(leaner.mesh.vertices, axis=0)
        slope = rng.uniform(0.2, 0.45)
        reach = extents.max() * np.cos(slope)
        height = np.ptp(prop.mesh.vertices[:, 2])
        if not (0.55 * reach < height and prop.mass_kg > 0.5 * leaner.mass_kg):
            continue
        upright = multiply_quaternions(_make_rotation((1.0, 0.0, 0.0), -slope), _turn_on_edge(extents))
        back, front = stand_on(prop, _UPRIGHT), stand_on(leaner, upright)
        near = -back.vertices()[:, 1].min() + front.vertices()[:, 1].max() + GAP_M
        aside = rng.uniform(-0.25, 0.25) * np.ptp(back.vertices()[:, 0])
        return [back, stand_on(leaner, upright, np.array([aside, -near, 0.0]))]
    return place_alone(rng)


def lay_across_edge(rng: np.random.Generator) -> list[PlacedModel]:
    """Lay a knife, pen, phone or banana over the edge of a plate, book or box."""
    base = stand_on(make_for_role(rng, "dish" if rng.random() < 0.5 else "base"), _UPRIGHT)
    model = make_for_role(rng, "flat")
    azimuth = rng.uniform(0.0, 2 * np.pi)
    toward = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    edge = float((base.vertices() @ toward).max())
    long_axis = int(np.argmax(np.ptp(model.mesh.vertices, axis=0)[:2]))
    spin = azimuth + rng.uniform(-0.4, 0.4) - (np.pi / 2 if long_axis == 1 else 0.0)
    height = float(base.vertices()[:, 2].max())
    place = toward * edge * rng.uniform(0.6, 0.95) + [0.0, 0.0, height]
    return [base, stand_on(model, quaternion_about_z(spin), place)]


RECIPES: dict[str, tuple[float, Recipe]] = {
    "alone": (0.36, place_alone),
    "stacked": (0.17, stack_on_base),
    "dished": (0.09, put_on_dish),
    "filled": (0.15, fill_container),
    "stirring": (0.08, put_utensils_in),
    "leaning": (0.09, lean_on_prop),
    "across": (0.06, lay_across_edge),
}


def make_group(rng: np.random.Generator) -> list[PlacedModel]:
    """Make a group by a recipe drawn by its weight."""
    weights = np.array([weight for weight, _ in RECIPES.values()])
    index = int(rng.choice(len(weights), p=weights / weights.sum()))
    return list(RECIPES.values())[index][1](rng)


def stand_on(model: GeneratedObject, rotation: Quaternion, place: Points | None = None) -> PlacedModel:
    """Turn an object and put its lowest point just above `place`, by default the origin."""
    offset = np.zeros(3) if place is None else np.asarray(place, dtype=np.float64)
    low = transform_points(Pose(np.zeros(3), rotation), model.mesh.vertices)[:, 2].min()
    return PlacedModel(model, Pose(offset + np.array([0.0, 0.0, GAP_M - low]), rotation))


def _draw_container(rng: np.random.Generator, wide: bool) -> tuple[GeneratedObject, GeneratorCavity]:
    while True:
        model = make_for_role(rng, "container")
        if model.cavity is not None and (model.cavity.rim_radius > 0.05) == wide:
            return model, model.cavity


def _put_on_top(rng: np.random.Generator, role: Role, below: PlacedModel) -> PlacedModel | None:
    """Put an object on another whose top its foot fits; None if there is no top, or nothing fits after `TRIES`."""
    top = below.model.top
    if top is None:
        return None
    half = np.array([top.half_x, top.half_y])
    for _ in range(TRIES):
        model = make_for_role(rng, role)
        foot = np.abs(model.mesh.vertices[model.mesh.vertices[:, 2] < FOOT_M][:, :2]).max(axis=0)
        if (foot <= half).all():
            shift = rng.uniform(-0.7, 0.7, 2) * (half - foot)
            place = below.pose.position + np.array([shift[0], shift[1], top.height])
            return stand_on(model, quaternion_about_z(rng.normal(0.0, 0.15)), place)
    return None


def _turn_on_edge(extents: np.ndarray) -> Quaternion:
    """Turn a flat object onto its edge: longest side up, thinnest towards y."""
    thin, tall = int(np.argmin(extents)), int(np.argmax(extents))
    if thin == 2:
        stood = _make_rotation((1.0, 0.0, 0.0), np.pi / 2)
        return stood if tall == 1 else multiply_quaternions(stood, _make_rotation((0.0, 0.0, 1.0), np.pi / 2))
    return _UPRIGHT


_UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def _make_rotation(axis: tuple[float, float, float], angle: float) -> Quaternion:
    return np.concatenate([[np.cos(angle / 2)], np.sin(angle / 2) * np.asarray(axis)])
