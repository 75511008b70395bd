"""Simulation of a layout in MuJoCo after its release: burst speed, stability, rest poses.

Bodies, table, contacts and the criterion of rest are those of the settle stage and of the certificate.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from schemas.config import SettleConfig
from schemas.geometry import ConvexPieces, Frozen, Pose
from schemas.objects import PlacedObjects
from schemas.scene import RectifiedLayout
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.mjcf.spec import SceneBody, make_simulation_spec
from tableverse_factory.physics.simulate.at_rest import Drift, find_free_bodies, make_quiet_data, measure_drift
from tableverse_factory.physics.simulate.certificate import DRIFT_LIMIT_M, DRIFT_LIMIT_RAD, DRIFT_TIME_S
from tableverse_factory.physics.simulate.settle_bodies import bring_to_rest, find_fallen, move_bodies
from tableverse_factory.physics.simulate.settle_near import settle_near
from tableverse_factory.stages.settle import make_bodies

BURST_TIME_S = 0.1
BURST_SPEED = 1.0
"""An object that falls freely for `BURST_TIME_S` reaches 0.98 m/s; a faster one was pushed out of another [m/s]."""


@dataclass(frozen=True, slots=True, eq=False)
class ReleasedScene(Frozen):
    """Bodies on their table, in the order of the layout's objects, ready to be simulated."""

    bodies: tuple[SceneBody, ...]
    slab: Slab

    @property
    def poses(self) -> tuple[Pose, ...]:
        """Poses of the bodies in the table frame."""
        return tuple(body.pose for body in self.bodies)

    @property
    def fallen(self) -> list[str]:
        """Ids of the objects that are no longer on the table."""
        return find_fallen(self.bodies, self.slab)

    def model(self, timestep_s: float) -> mujoco.MjModel:
        """Compile the scene without visual geometry."""
        return make_simulation_spec(self.bodies, self.slab, timestep_s).compile()


def make_scene(item: PlacedObjects, pieces: Sequence[ConvexPieces], poses: Sequence[Pose]) -> ReleasedScene:
    """Build a scene of the layout's objects at poses in the table frame."""
    layout = RectifiedLayout(item.scene_id, item, tuple(pieces), tuple(poses), tuple(range(len(poses))), 0.0)
    return ReleasedScene(*make_bodies(layout))


def simulate_to_rest(scene: ReleasedScene, config: SettleConfig, gentle: bool) -> tuple[ReleasedScene, bool]:
    """Simulate to rest; return the scene and whether it came to rest within the time limit."""
    ended, rest = bring_to_rest(
        scene.bodies, scene.slab, timestep_s=config.timestep_s, max_time_s=config.max_time_s, gentle=gentle
    )
    return replace(scene, bodies=ended), rest.at_rest


def simulate_near(scene: ReleasedScene, seen: Mapping[str, Pose], config: SettleConfig) -> tuple[ReleasedScene, bool]:
    """Simulate to rest near the seen poses, by id; return the scene and whether it came to rest within the limit."""
    step, limit = config.timestep_s, config.max_time_s
    ended, rest = settle_near(scene.bodies, seen, scene.slab, timestep_s=step, max_time_s=limit)
    return replace(scene, bodies=ended), rest.at_rest


def simulate_freely(scene: ReleasedScene, seconds: float, timestep_s: float) -> ReleasedScene:
    """Return the scene after a free simulation."""
    model = scene.model(timestep_s)
    return replace(scene, bodies=move_bodies(scene.bodies, measure_drift(model, seconds).poses))


def measure_burst_speed(scene: ReleasedScene, timestep_s: float) -> float:
    """Measure the largest speed of a centre of mass in the first `BURST_TIME_S` of a free simulation [m/s]."""
    model = scene.model(timestep_s)
    data, bodies = make_quiet_data(model), find_free_bodies(model)
    fastest = 0.0
    mujoco.mj_kinematics(model, data)
    centers = data.xipos[bodies].copy()
    for _ in range(round(BURST_TIME_S / timestep_s)):
        mujoco.mj_step(model, data)
        mujoco.mj_kinematics(model, data)
        moved = np.linalg.norm(data.xipos[bodies] - centers, axis=1)
        fastest = max(fastest, float(moved.max(initial=0.0)) / timestep_s)
        centers = data.xipos[bodies].copy()
    return fastest


def is_stable(scene: ReleasedScene, timestep_s: float) -> bool:
    """Check that no object has fallen or moves beyond the certificate's limits within its drift time."""
    model = scene.model(timestep_s)
    # A short simulation already shows an unstable scene; the whole drift time is for the others.
    return not scene.fallen and all(_is_still(measure_drift(model, time)) for time in (2 * BURST_TIME_S, DRIFT_TIME_S))


def _is_still(drift: Drift) -> bool:
    beyond = (drift.distance_m > DRIFT_LIMIT_M) | (drift.angle_rad > DRIFT_LIMIT_RAD)
    return not beyond.any() and not drift.warnings
