"""Solver settings of a model and contact settings of its objects, with which scenes rest."""

from dataclasses import dataclass

import mujoco
import numpy as np

_MULTICCD = int(mujoco.mjtDisableBit.mjDSBL_MULTICCD)
_SOLIMP_SIZE = 5


@dataclass(frozen=True, slots=True)
class SolverSettings:
    """What MuJoCo's solver is told, with the names of MJCF's `option`."""

    timestep: float  # [s]
    gravity: tuple[float, ...]  # [m/s²]
    integrator: str
    cone: str
    impratio: float
    noslip_iterations: int
    multiccd: bool


@dataclass(frozen=True, slots=True)
class ContactSettings:
    """What MuJoCo is told of contacts of an object, with the names of MJCF's `geom`."""

    condim: int = 3
    solref: tuple[float, ...] = (0.02, 1.0)
    solimp: tuple[float, ...] = (0.9, 0.95, 0.001, 0.5, 2.0)


def read_solver_settings(model: mujoco.MjModel) -> SolverSettings:
    """Read the solver settings of a compiled model."""
    option = model.opt
    return SolverSettings(
        float(option.timestep),
        tuple(option.gravity.tolist()),
        mujoco.mjtIntegrator(option.integrator).name.removeprefix("mjINT_").lower(),
        mujoco.mjtCone(option.cone).name.removeprefix("mjCONE_").lower(),
        float(option.impratio),
        int(option.noslip_iterations),
        not option.disableflags & _MULTICCD,
    )


def read_contact_settings(model: mujoco.MjModel, colliders: list[int]) -> ContactSettings:
    """Read the contact settings of an object: those of its first collider, and the most directions of friction."""
    if not colliders:
        return ContactSettings()
    first = colliders[0]
    return ContactSettings(
        int(np.max(model.geom_condim[colliders])),
        tuple(model.geom_solref[first].tolist()),
        tuple(model.geom_solimp[first][:_SOLIMP_SIZE].tolist()),
    )
