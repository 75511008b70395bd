"""What happens to a layout when it is let go in MuJoCo: how hard it bursts, whether it stays, where it comes to rest.

Bodies, table, contacts and the measure of rest are those of the settle stage and of the certificate.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from schemas.config import SettleConfig
from schemas.geometry import ConvexPieces, Frozen, Pose
from schemas.objects import PlacedObjects
from schemas.scene import RectifiedLayout
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.mjcf.spec import SceneBody, scene_spec
from tableverse_factory.physics.simulate.at_rest import Drift, free_bodies, measure_drift, quiet_data
from tableverse_factory.physics.simulate.certificate import DRIFT_LIMIT_M, DRIFT_LIMIT_RAD, DRIFT_TIME_S
from tableverse_factory.physics.simulate.settle_bodies import bring_to_rest, fallen, moved_to
from tableverse_factory.stages.settle import bodies_on_table

BURST_TIME_S = 0.1
BURST_SPEED = 1.0
"""What falls freely for `BURST_TIME_S` gets to 0.98 m/s; what is faster than this was pushed out of something."""


@dataclass(frozen=True, slots=True, eq=False)
class ReleasedScene(Frozen):
    """Bodies on their table, ready to be simulated.

    Attributes:
        bodies: In the order of the layout's objects.
        slab: The table.
    """

    bodies: tuple[SceneBody, ...]
    slab: Slab

    @property
    def poses(self) -> tuple[Pose, ...]:
        """Of the bodies, in the table frame."""
        return tuple(body.pose for body in self.bodies)

    @property
    def fallen(self) -> list[str]:
        """Ids of what is no longer on the table."""
        return fallen(self.bodies, self.slab)

    def model(self, timestep_s: float) -> mujoco.MjModel:
        """Compiled, without what is only to be seen."""
        return scene_spec(self.bodies, self.slab, timestep_s=timestep_s, visuals=False)[0].compile()


def scene_at(item: PlacedObjects, pieces: Sequence[ConvexPieces], poses: Sequence[Pose]) -> ReleasedScene:
    """The layout's objects at poses of the table frame."""
    layout = RectifiedLayout(item.scene_id, item, tuple(pieces), tuple(poses), tuple(range(len(poses))), 0.0)
    return ReleasedScene(*bodies_on_table(layout))


def at_rest(scene: ReleasedScene, config: SettleConfig, gentle: bool) -> tuple[ReleasedScene, bool]:
    """The scene after a simulation to rest, and whether it got there before the time was up.

    Args:
        scene: From where.
        config: Time step and bound on the time.
        gentle: As the settle stage does it, or let go freely.
    """
    ended, rest = bring_to_rest(
        scene.bodies, scene.slab, timestep_s=config.timestep_s, max_time_s=config.max_time_s, gentle=gentle
    )
    return replace(scene, bodies=ended), rest.at_rest


def after(scene: ReleasedScene, seconds: float, timestep_s: float) -> ReleasedScene:
    """The scene after so much free simulation."""
    model = scene.model(timestep_s)
    return replace(scene, bodies=moved_to(scene.bodies, measure_drift(model, seconds).poses))


def burst_speed(scene: ReleasedScene, timestep_s: float) -> float:
    """Largest speed of a centre of mass within the first `BURST_TIME_S` of a free simulation [m/s]."""
    model = scene.model(timestep_s)
    data, bodies = quiet_data(model), free_bodies(model)
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


def stays(scene: ReleasedScene, timestep_s: float) -> bool:
    """Whether nothing has fallen, and nothing moves beyond the certificate's limits within its drift time."""
    model = scene.model(timestep_s)
    # What was never simulated gives itself away at once; the whole time is for what looks still.
    return not scene.fallen and all(_is_still(measure_drift(model, time)) for time in (2 * BURST_TIME_S, DRIFT_TIME_S))


def _is_still(drift: Drift) -> bool:
    beyond = (drift.distance_m > DRIFT_LIMIT_M) | (drift.angle_rad > DRIFT_LIMIT_RAD)
    return not beyond.any() and not drift.warnings
