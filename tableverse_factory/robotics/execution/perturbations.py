"""Would it still work if friction or mass were other than we think? The same motion in a scene that was changed."""

import copy
from collections.abc import Callable, Mapping

import mujoco
import numpy as np

from schemas.geometry import Pose
from schemas.trajectories import Motion
from tableverse_factory.physics.simulate.at_rest import quiet_data
from tableverse_factory.robotics.execution.execute import execute_and_check
from tableverse_factory.robotics.execution.goal import Goal
from tableverse_factory.robotics.robots.station import Station


def _friction(station: Station, body: int, factor: float) -> None:
    """Of the carried object and of the fingers: sliding and torsional.

    Rolling friction stays, it keeps round things still; and so does all friction of what is not carried: what leans
    may slide by itself on a smoother table, and that would say nothing of the motion.
    """
    model = station.model
    touched = np.concatenate([np.flatnonzero(model.geom_bodyid == body), station.finger_geoms])
    model.geom_friction[touched, :2] *= factor


def _mass(station: Station, body: int, factor: float) -> None:
    """Of the carried object, and its inertia with it."""
    station.model.body_mass[body] *= factor
    station.model.body_inertia[body] *= factor
    mujoco.mj_setConst(station.model, quiet_data(station.model))


CHANGES: Mapping[str, tuple[Callable[[Station, int, float], None], float]] = {
    "friction_halved": (_friction, 0.5),
    "friction_doubled": (_friction, 2.0),
    "mass_minus_30": (_mass, 0.7),
    "mass_plus_30": (_mass, 1.3),
}
"""Each name, as it stands in the column `survives`, with what it changes and by which factor."""


def changed(station: Station, name: str, object_id: str) -> Station:
    """The station with one of `CHANGES`; the one that is given stays as it is."""
    change, factor = CHANGES[name]
    other = copy.copy(station)
    other.model = copy.copy(station.model)
    change(other, station.object_bodies[object_id], factor)
    return other


def robust_to(station: Station, base: Pose, motion: Motion, goal: Goal) -> tuple[str, ...]:
    """Names of the changes under which the motion succeeds as well, in the order of `CHANGES`."""
    return tuple(
        name
        for name in CHANGES
        if execute_and_check(changed(station, name, goal.x_id), base, motion, goal).verdict.success
    )
