"""Rest of scenes in Newton, measured as the certificate measures it in MuJoCo."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Pose
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.learning.newton import NewtonScene
from tableverse_factory.evaluation.engine_drift import EngineDrift, measure_motion
from tableverse_factory.geometry.math.transforms import normalize_quaternion
from tableverse_factory.physics.simulate.at_rest import NUDGE_INTERVAL_S, NUDGES


def measure_newton_drift(scenes: Sequence[Scene], duration_s: float, device: str | None = None) -> list[EngineDrift]:
    """Step scenes in Newton for `duration_s`, one after another, with the certificate's nudges, and measure each."""
    return [_measure_scene(scene, duration_s, device) for scene in scenes]


def _measure_scene(scene: Scene, duration_s: float, device: str | None) -> EngineDrift:
    world = NewtonScene(scene, device)
    start = _read_poses(world)
    steps, awake = (round(seconds / world.timestep_s) for seconds in (duration_s, min(NUDGE_INTERVAL_S, duration_s)))
    contacts, depth_m = 0, 0.0
    for nudge, count in ((NUDGES[0], 1), (None, awake - 1), (NUDGES[1], steps - awake)):
        if nudge is not None:
            velocity = world.state.joint_qd.numpy()
            world.state.joint_qd.assign(velocity + np.tile(nudge, len(velocity) // 6))
        world.step(count)
        if count == 1:
            contacts, depth_m = _read_contacts(world)
    end = _read_poses(world)
    centers = world.model.body_com.numpy().astype(np.float64)
    motion = measure_motion(
        (_as_pose(start[k]), _as_pose(end[k]), centers[k])
        for k, name in enumerate(world.model.body_label)
        if not name.endswith("/table")
    )
    full = bool(np.any(world.solver.mjw_data.overflow.numpy()))
    return EngineDrift(scene.scene_id, *motion, contacts, depth_m, full)


def _read_poses(world: NewtonScene) -> Float64[np.ndarray, "bodies 7"]:
    """Read positions [m] and quaternions xyzw of all bodies."""
    return np.asarray(world.state.body_q.numpy(), dtype=np.float64)


def _as_pose(row: Float64[np.ndarray, "7"]) -> Pose:
    return Pose(row[:3], normalize_quaternion(row[[6, 3, 4, 5]]))


def _read_contacts(world: NewtonScene) -> tuple[int, float]:
    """Read number and greatest depth [m] of the contacts of the last step."""
    data = world.solver.mjw_data
    depth = -data.contact.dist.numpy()[: int(data.nacon.numpy()[0])]
    return len(depth), float(depth.max(initial=0.0))
