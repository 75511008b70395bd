"""Clutter: objects of other scenes, drawn to stand around what is carried without touching anything."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from schemas.geometry import Frozen, Points, Pose
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.evaluation.benchmark.added_objects import PREFIX, add_objects
from tableverse_factory.evaluation.benchmark.benchmark import AddedObject
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import compose_poses, quaternion_about_z, transform_points
from tableverse_factory.physics.mjcf.scene_objects import SceneObject, load_scene_objects, read_slab
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.station import Station

GAP_M = 0.02  # least distance of the boxes of added objects to all others and to the goal
NEAR_M = 0.15  # greatest distance of their boxes to that of X or of the goal
EDGE_M = 0.02  # least distance to the table's edge
BASE_M = 0.2  # least distance to the axis of the arm's base
MAX_SIDE_M = 0.2  # of added objects
STANDING_M = 0.002  # an object whose lowest point is no higher stands on the table
PLACES = 60  # tried for each object
REST_S, REST_M = 1.0, 0.001  # nothing moves by more in this time


@dataclass(frozen=True, slots=True, eq=False)
class _Site(Frozen):
    """Where clutter may stand; boxes are pairs of corners in the table frame [m]."""

    slab: Slab
    base: Pose
    boxes: list[tuple[Points, Points]]  # of everything that keeps its distance
    near: list[tuple[Points, Points]]  # of X and of its goal


def draw_clutter(
    scene: Scene,
    donors: Sequence[Scene],
    x_id: str,
    goal: Points,
    arm: Arm,
    base: Pose,
    count: int,
    rng: np.random.Generator,
) -> tuple[AddedObject, ...]:
    """Draw up to `count` objects of the donors that stand near X or its goal, and rest in simulation.

    `goal` are the vertices of X where a recorded motion put it, in the table frame [m], and `base` is the pose of the
    arm that carried it there. Each object keeps its orientation up to a turn about the vertical.
    """
    objects = load_scene_objects(scene.files(), scene.object_rows())
    boxes = [aabb(thing.standing.vertices) for thing in objects.values()]
    near = [aabb(objects[x_id].standing.vertices), aabb(goal)]
    site = _Site(read_slab(scene.files()), base, [*boxes, aabb(goal)], near)
    chosen: list[tuple[Scene, AddedObject]] = []
    for donor, object_id, thing in _iterate_standing(donors, rng):
        for place in _iterate_places(site, thing, rng):
            added = AddedObject(scene_id=donor.scene_id, object_id=object_id, pose=_make_row(place))
            if _rests(add_objects(scene, [*chosen, (donor, added)]), arm, base):
                chosen.append((donor, added))
                site.boxes.append(aabb(transform_points(place, thing.mesh.vertices)))
                break
        if len(chosen) == count:
            break
    return tuple(added for _, added in chosen)


def _iterate_standing(donors: Sequence[Scene], rng: np.random.Generator) -> Iterator[tuple[Scene, str, SceneObject]]:
    """Iterate the small objects that stand on the table by themselves, in random order, one of each donor in turn."""
    for index in rng.permutation(len(donors)).tolist():
        donor = donors[index]
        rows: list[Mapping[str, object]] = [row for row in donor.object_rows() if row["contained_in"] is None]
        objects = load_scene_objects(donor.files(), rows)
        names = [name for name, thing in objects.items() if _may_stand(thing)]
        if names:
            name = names[int(rng.integers(len(names)))]
            yield donor, name, objects[name]


def _may_stand(thing: SceneObject) -> bool:
    low, high = aabb(thing.standing.vertices)
    return bool(abs(low[2]) <= STANDING_M and (high - low).max() <= MAX_SIDE_M)


def _iterate_places(site: _Site, thing: SceneObject, rng: np.random.Generator) -> Iterator[Pose]:
    """Iterate poses of an object, turned and shifted, that keep their distances."""
    low, high = aabb(thing.standing.vertices)
    middle = np.array([*((low + high) / 2)[:2], 0.0])
    for _ in range(PLACES):
        box = site.near[int(rng.integers(len(site.near)))]
        reach = NEAR_M + float((high - low)[:2].max()) / 2
        spot = rng.uniform(box[0][:2] - reach, box[1][:2] + reach)
        turn = Pose(np.zeros(3), quaternion_about_z(float(rng.uniform(-np.pi, np.pi))))
        to_middle = Pose(-middle, np.array([1.0, 0.0, 0.0, 0.0]))
        there = Pose(np.array([*spot, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))
        pose = compose_poses(there, compose_poses(turn, compose_poses(to_middle, thing.pose)))
        if _has_room(site, transform_points(pose, thing.mesh.vertices)):
            yield pose


def _has_room(site: _Site, vertices: Points) -> bool:
    low, high = aabb(vertices)
    inner = Slab(site.slab.center_xy, site.slab.half_size_xy - EDGE_M, site.slab.yaw, site.slab.color)
    away = np.linalg.norm(vertices[:, :2] - site.base.position[:2], axis=1).min()
    near = min(_measure_gap(low, high, box) for box in site.near)
    clear = min(_measure_gap(low, high, box) for box in site.boxes)
    return bool(inner.holds(vertices).all() and away >= BASE_M and near <= NEAR_M and clear >= GAP_M)


def _measure_gap(low: Points, high: Points, box: tuple[Points, Points]) -> float:
    """Measure the horizontal gap of two boxes along the axis of largest separation [m]; negative where they overlap."""
    return float(np.maximum(low - box[1], box[0] - high)[:2].max())


def _rests(scene: Scene, arm: Arm, base: Pose) -> bool:
    """Test in simulation, with the arm at home, that nothing moves and the arm touches none of the added objects."""
    station = Station(scene.files(), arm, base)
    data = station.data()
    added = {body for name, body in station.object_bodies.items() if name.startswith(PREFIX)}
    pairs = station.model.geom_bodyid[data.contact.geom]
    if any(added & set(pair) and set(station.arm_bodies.tolist()) & set(pair) for pair in pairs.tolist()):
        return False
    bodies = list(station.object_bodies.values())
    before = data.xpos[bodies].copy()
    mujoco.mj_step(station.model, data, nstep=round(REST_S / station.model.opt.timestep))
    moved = np.linalg.norm(data.xpos[bodies] - before, axis=1)
    return bool(np.isfinite(moved).all() and moved.max() <= REST_M)


def _make_row(pose: Pose) -> tuple[float, ...]:
    return tuple(round(float(value), 9) for value in (*pose.position, *pose.quaternion_wxyz))
