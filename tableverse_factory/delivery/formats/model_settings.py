"""Solver settings of a model and contact settings of its colliders, with which scenes rest."""

from dataclasses import dataclass

import mujoco

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
    """What MuJoCo is told of contacts of a collider, with the names of MJCF's `geom`."""

    condim: int
    friction: tuple[float, ...]  # sliding, torsional [m], rolling [m]
    solref: tuple[float, ...]
    solimp: tuple[float, ...]


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


def read_contact_settings(model: mujoco.MjModel, geom: int) -> ContactSettings:
    """Read the contact settings of a collider."""
    return ContactSettings(
        int(model.geom_condim[geom]),
        tuple(model.geom_friction[geom].tolist()),
        tuple(model.geom_solref[geom].tolist()),
        tuple(model.geom_solimp[geom][:_SOLIMP_SIZE].tolist()),
    )
