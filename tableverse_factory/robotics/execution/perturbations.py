"""Robustness to physical parameters: the same motion in a scene with other friction or mass."""

import copy
from collections.abc import Callable, Mapping

import mujoco
import numpy as np

from schemas.geometry import Pose
from schemas.trajectories import Motion
from tableverse_factory.physics.simulate.at_rest import make_quiet_data
from tableverse_factory.robotics.execution.execute import execute_and_check
from tableverse_factory.robotics.execution.goal import Goal
from tableverse_factory.robotics.robots.station import Station


def scale_friction(station: Station, body: int, factor: float) -> None:
    """Scale sliding and torsional friction of the carried object and the fingers.

    Rolling friction stays, as it keeps round objects still; friction of other objects stays, as leaning ones could
    slide by themselves, which says nothing of the motion.
    """
    model = station.model
    touched = np.concatenate([np.flatnonzero(model.geom_bodyid == body), station.finger_geoms])
    model.geom_friction[touched, :2] *= factor


def _scale_mass(station: Station, body: int, factor: float) -> None:
    """Scale mass and inertia of the carried object."""
    station.model.body_mass[body] *= factor
    station.model.body_inertia[body] *= factor
    mujoco.mj_setConst(station.model, make_quiet_data(station.model))


# Change and factor by name, as in the column `survives`
PERTURBATIONS: Mapping[str, tuple[Callable[[Station, int, float], None], float]] = {
    "friction_halved": (scale_friction, 0.5),
    "friction_doubled": (scale_friction, 2.0),
    "mass_minus_30": (_scale_mass, 0.7),
    "mass_plus_30": (_scale_mass, 1.3),
}


def perturb_station(station: Station, name: str, object_id: str) -> Station:
    """Return a copy of the station with one of `PERTURBATIONS`."""
    change, factor = PERTURBATIONS[name]
    other = copy.copy(station)
    other.model = copy.copy(station.model)
    change(other, station.object_bodies[object_id], factor)
    return other


def find_survived_perturbations(station: Station, base: Pose, motion: Motion, goal: Goal) -> tuple[str, ...]:
    """List the perturbations under which the motion still succeeds, in the order of `PERTURBATIONS`."""
    return tuple(
        name
        for name in PERTURBATIONS
        if execute_and_check(perturb_station(station, name, goal.x_id), base, motion, goal).verdict.success
    )
