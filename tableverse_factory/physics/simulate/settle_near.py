"""Settling near the seen poses: a body that strays is put down again from poses within the noise of registration.

A body may topple or slide from the pose that rectification gave it, and hold from another one that the picture allows
as well. It is put down from several, each time alone while all others stand still; then all settle together.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np

from schemas.geometry import Pose, Vector3
from tableverse_factory.geometry.collision.linear_sweep import LinearSweep, MovingSolid
from tableverse_factory.geometry.collision.solids import Solids
from tableverse_factory.geometry.math.transforms import (
    multiply_quaternions,
    normalize_quaternion,
    quaternion_from_rotation_vector,
    rotation_matrix,
    transform_points,
    translate_pose,
)
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.mjcf.spec import SceneBody, make_simulation_spec
from tableverse_factory.physics.simulate.at_rest import GENTLE_RATE, Rest, make_quiet_data
from tableverse_factory.physics.simulate.settle_bodies import bring_to_rest, find_fallen, simulate_bodies

# Deviations that count as one: of a seen position along x, y and z [m], and of a seen tilt [rad].
NOISE_M = np.array([0.007, 0.007, 0.0035])
NOISE_RAD = np.radians(2.0)
STRAY = 8.5  # a body that deviates by more than this has gone astray
NEARER = 0.7  # it is worth another simulation of all bodies where it deviates by less than this share of that
NEAR, AGAIN = 2.5, 2  # as many ends are tried with all bodies; the search ends with as many that deviate this little
AGAIN_S = 3.0  # simulated time for that, at most [s]
TILTS_RAD, SHIFTS_M = np.radians([2.0, 4.0]), (0.006, 0.012)  # of the starts, in turn
AZIMUTHS = 8  # directions of both; the half that leads back is used
MAX_LIFT_M = 0.05  # starts that are free no lower than this above the seen pose are left out [m]
GAP_M = 0.0003  # from a start to all others [m]
GENTLE_STEPS, SAMPLES, STEPS_PER_SAMPLE = 75, 20, 20  # of putting down one body: damped steps, then free ones
STILL_M = 5e-5  # a body that moves by less than this from sample to sample lies [m]
UP = np.array([0.0, 0.0, 1.0])


def settle_near(
    bodies: Sequence[SceneBody], seen: Mapping[str, Pose], slab: Slab, *, timestep_s: float, max_time_s: float
) -> tuple[tuple[SceneBody, ...], Rest]:
    """Bring bodies to rest, gently, and those that stray from their `seen` poses, by id, once more from near them.

    Another rest is taken where all together deviate less and nothing falls. Its time is that of all rests taken.
    """
    released = tuple(bodies)
    ended, rest = bring_to_rest(bodies, slab, timestep_s=timestep_s, max_time_s=max_time_s, gentle=True)
    if rest.warnings or not seen:
        return ended, rest
    again_s = min(max_time_s, AGAIN_S)
    for name in sorted(seen, key=lambda name: (float(seen[name].position[2]), name)):
        stray = next(body for body in ended if body.object_id == name)
        if measure_deviation(stray, seen) <= STRAY:
            continue
        others = [body for body in released if body.object_id != name]
        for nearer in _put_down(stray, seen, others, slab, timestep_s):
            placed = tuple(nearer if body.object_id == name else body for body in released)
            again, new = simulate_bodies(placed, slab, timestep_s, again_s, gentle=True)
            nearer_all = _sum_deviations(again, seen) < _sum_deviations(ended, seen)
            if new.at_rest and nearer_all and not find_fallen(again, slab):
                released, ended, rest = placed, again, replace(new, time_s=rest.time_s + new.time_s)
                break
    return ended, rest


def measure_deviation(body: SceneBody, seen: Mapping[str, Pose]) -> float:
    """Measure how far the centre of mass and the tilt of a body are from its seen pose, in units of the noise."""
    pose = seen[body.object_id]
    turn = rotation_matrix(body.pose.quaternion_wxyz) @ rotation_matrix(pose.quaternion_wxyz).T
    tilt = float(np.arccos(np.clip(turn[2, 2], -1.0, 1.0)))
    return float(np.linalg.norm([*(_compute_way(body, pose) / NOISE_M), tilt / NOISE_RAD]))


def _compute_way(body: SceneBody, pose: Pose) -> Vector3:
    """Compute the way of the centre of mass from another pose [m]."""
    center = body.properties.center[None]
    way: Vector3 = (transform_points(body.pose, center) - transform_points(pose, center))[0]
    return way


def _sum_deviations(bodies: Sequence[SceneBody], seen: Mapping[str, Pose]) -> float:
    return sum(measure_deviation(body, seen) for body in bodies if body.object_id in seen)


def _put_down(
    stray: SceneBody, seen: Mapping[str, Pose], standing: Sequence[SceneBody], slab: Slab, timestep_s: float
) -> list[SceneBody]:
    """Put a body down from starts around its seen pose; returns where it lies nearest to that, at most `AGAIN`."""
    model = _freeze([stray, *standing], slab, timestep_s)
    ends: list[tuple[float, int, SceneBody]] = []
    limit = NEARER * measure_deviation(stray, seen)
    for k, start in enumerate(_list_starts(stray, seen[stray.object_id], standing)):
        found = _let_down(start, model, seen, limit)
        if found is not None:
            ends.append((measure_deviation(found, seen), k, found))
        if sum(deviation < NEAR for deviation, _, _ in ends) == AGAIN:
            break
    return [body for _, _, body in sorted(ends, key=lambda end: end[:2])[:AGAIN]]


def _freeze(bodies: Sequence[SceneBody], slab: Slab, timestep_s: float) -> mujoco.MjModel:
    """Compile a scene in which the first body is free and the others stand still."""
    spec = make_simulation_spec(bodies, slab, timestep_s)
    for body in bodies[1:]:
        spec.delete(spec.joint(body.object_id))
    return spec.compile()


def _let_down(start: SceneBody, model: mujoco.MjModel, seen: Mapping[str, Pose], deviation: float) -> SceneBody | None:
    """Simulate from a start until the body lies; None once it deviates further than `deviation`."""
    data = make_quiet_data(model)
    data.qpos[:] = [*start.pose.position, *start.pose.quaternion_wxyz]
    decay = float(np.exp(-GENTLE_RATE * model.opt.timestep))
    for _ in range(GENTLE_STEPS):
        mujoco.mj_step(model, data)
        data.qvel *= decay
    body = start
    for _ in range(SAMPLES):
        before = data.qpos.copy()
        mujoco.mj_step(model, data, nstep=STEPS_PER_SAMPLE)
        body = replace(start, pose=Pose(data.qpos[:3].copy(), normalize_quaternion(data.qpos[3:])))
        if not measure_deviation(body, seen) < deviation:
            return None
        if np.abs(data.qpos - before).max() < STILL_M:
            break
    return body


def _list_starts(stray: SceneBody, seen: Pose, standing: Sequence[SceneBody]) -> Iterator[SceneBody]:
    """Give starts at the seen pose, then tilted and shifted against the way that the body went, lifted until free."""
    fixed, lift = [_make_solid(body) for body in standing], LinearSweep(UP)
    untilted = _make_solid(replace(stray, pose=seen))
    for shift, turn in _list_moves(_compute_way(stray, seen)):
        start = _move(replace(stray, pose=seen), shift, turn)
        solid = _make_solid(start) if turn.any() else untilted.moved(shift)
        rise = max(GAP_M - float(solid.solids.low[:, 2].min()), 0.0)
        height = rise + lift.find_first_clear([solid.moved(rise * UP)], fixed, GAP_M)
        if height <= MAX_LIFT_M:
            yield replace(start, pose=translate_pose(start.pose, height * UP))


def _list_moves(way: Vector3) -> list[tuple[Vector3, Vector3]]:
    """List shifts [m] and rotation vectors [rad], the opposite of the way first."""
    angles = np.arange(AZIMUTHS) * 2 * np.pi / AZIMUTHS
    around = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(AZIMUTHS)])
    around = around[np.argsort(np.round(around @ way, 9), kind="stable")]
    none = np.zeros(3)
    moves = [(none, none)]
    for tilt, shift in zip(TILTS_RAD, SHIFTS_M, strict=True):
        for direction in around[: AZIMUTHS // 2]:
            moves += [(none, tilt * np.cross(UP, direction)), (shift * direction, none)]
    return moves


def _move(body: SceneBody, shift: Vector3, turn: Vector3) -> SceneBody:
    """Shift a body, and turn it about its centre of mass."""
    center = transform_points(body.pose, body.properties.center[None])[0]
    quaternion = quaternion_from_rotation_vector(turn)
    position = rotation_matrix(quaternion) @ (body.pose.position - center) + center + shift
    return replace(
        body, pose=Pose(position, normalize_quaternion(multiply_quaternions(quaternion, body.pose.quaternion_wxyz)))
    )


def _make_solid(body: SceneBody) -> MovingSolid:
    vertices = [transform_points(body.pose, hull.vertices) for hull in body.hulls]
    return MovingSolid(Solids(vertices, [hull.faces for hull in body.hulls]), np.zeros(3))
