"""Rest of scenes in MuJoCo and in MuJoCo Warp, measured as the certificate measures it."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from schemas.geometry import Pose, Vector3
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.learning.vector_sim import compile_scene
from tableverse_factory.delivery.learning.warp import WarpBatch
from tableverse_factory.geometry.math.transforms import normalize_quaternion, rotation_angle, transform_points
from tableverse_factory.physics.simulate.at_rest import NUDGE_INTERVAL_S, NUDGES, make_quiet_data, measure_drift
from tableverse_factory.physics.simulate.certificate import DRIFT_LIMIT_M, DRIFT_LIMIT_RAD, FALL_M


@dataclass(frozen=True, slots=True)
class EngineDrift:
    """Largest motion of a scene's objects in an engine, and its contacts before the first step.

    `overflowed` says that the engine lacked room for contacts or constraints or became unstable, so that the rest is
    meaningless.
    """

    scene_id: str
    drift_m: float
    drift_rad: float
    sunk_m: float
    contacts: int
    penetration_m: float
    overflowed: bool

    @property
    def at_rest(self) -> bool:
        """Whether nothing moved beyond the certificate's limits, or fell."""
        near = self.drift_m <= DRIFT_LIMIT_M and self.drift_rad <= DRIFT_LIMIT_RAD and self.sunk_m <= FALL_M
        return near and not self.overflowed


def measure_mujoco_drift(scene: Scene, duration_s: float) -> EngineDrift:
    """Step a scene in MuJoCo for `duration_s`, with the certificate's nudges, and measure it."""
    model = compile_scene(scene, visuals=False)
    data = make_quiet_data(model)
    mujoco.mj_forward(model, data)
    contacts, depth_m = int(data.ncon), float((-data.contact.dist).max(initial=0.0))
    drift = measure_drift(model, duration_s)
    distance_m, angle_rad, sunk_m = (
        float(values.max(initial=0.0)) for values in (drift.distance_m, drift.angle_rad, drift.sunk_m)
    )
    return EngineDrift(scene.scene_id, distance_m, angle_rad, sunk_m, contacts, depth_m, bool(drift.warnings))


def measure_warp_drift(
    scenes: Sequence[Scene], duration_s: float, device: str | None = None, exported_settings: bool = False
) -> list[EngineDrift]:
    """Step scenes in one batch of MuJoCo Warp for `duration_s`, with the certificate's nudges, and measure each.

    `exported_settings` are those of `WarpBatch`.
    """
    batch = WarpBatch(scenes, device=device, exported_settings=exported_settings)
    touching = _read_contacts(batch)
    start = batch.poses()
    steps, awake = (
        round(seconds / batch.template.opt.timestep) for seconds in (duration_s, min(NUDGE_INTERVAL_S, duration_s))
    )
    for nudge, count in ((NUDGES[0], awake), (NUDGES[1], steps - awake)):
        velocity = batch.data.qvel.numpy()
        velocity += np.tile(nudge, velocity.shape[1] // 6)
        batch.data.qvel.assign(velocity)
        batch.step(count)
    end, full = batch.poses(), batch.overflowed()
    return [
        EngineDrift(
            scene_id, *measure_motion(_list_motions(batch, world, start, end)), *touching[world], bool(full[world])
        )
        for world, scene_id in enumerate(batch.scene_ids)
    ]


def _read_contacts(batch: WarpBatch) -> list[tuple[int, float]]:
    """Read number and greatest depth [m] of each world's contacts."""
    count = int(batch.data.nacon.numpy()[0])
    world, depth = batch.data.contact.worldid.numpy()[:count], -batch.data.contact.dist.numpy()[:count]
    found = (depth[world == index] for index in range(len(batch.scene_ids)))
    return [(len(its), float(its.max(initial=0.0))) for its in found]


def measure_motion(bodies: Iterable[tuple[Pose, Pose, Vector3]]) -> tuple[float, float, float]:
    """Measure the largest displacement of a centre of mass [m], rotation [rad], and way down [m].

    `bodies` are each one's poses at the start and at the end, and its centre of mass in its own frame [m].
    """
    found = []
    for start, end, center in bodies:
        way = (transform_points(end, center[None]) - transform_points(start, center[None]))[0]
        turn = rotation_angle(start.quaternion_wxyz, end.quaternion_wxyz)
        found.append((float(np.linalg.norm(way)), turn, float(-way[2])))
    distance_m, angle_rad, sunk_m = (max(values) for values in zip(*found, strict=True))
    return distance_m, angle_rad, sunk_m


def _list_motions(
    batch: WarpBatch, world: int, start: np.ndarray, end: np.ndarray
) -> Iterator[tuple[Pose, Pose, Vector3]]:
    for slot, name in enumerate(batch.object_ids[world]):
        a, b = (Pose(row[:3], normalize_quaternion(row[3:])) for row in (start[world, slot], end[world, slot]))
        yield a, b, batch.models[world].body(name).ipos
