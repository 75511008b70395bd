"""Sizes of a scene for simulators that allot memory before they step, such as MuJoCo Warp."""

from dataclasses import dataclass

import mujoco
import numpy as np

from tableverse_factory.physics.simulate.at_rest import make_quiet_data

MARGIN = 2  # things that are pushed together touch more often than at rest
_STEP = 32  # sizes are multiples of it
_ROWS = 512  # geoms that are compared with all others at a time: memory for all at once grows with their square


@dataclass(frozen=True, slots=True)
class SimulationSizes:
    """Sizes for one world, named as in MuJoCo Warp: twice what the initial state needs, so that things may move.

    Attributes:
        nv: Degrees of freedom, exactly.
        nconmax: Contacts, and pairs of geoms near enough to be tested for one.
        njmax: Scalar constraints.
    """

    nv: int
    nconmax: int
    njmax: int


def measure_sizes(model: mujoco.MjModel) -> SimulationSizes:
    """Measure the sizes on the initial state of a model."""
    data = make_quiet_data(model)
    mujoco.mj_forward(model, data)
    contacts = max(int(data.ncon), count_near_pairs(model, data))
    return SimulationSizes(int(model.nv), _round_up(MARGIN * contacts), _round_up(MARGIN * int(data.nefc)))


def count_near_pairs(model: mujoco.MjModel, data: mujoco.MjData) -> int:
    """Count the pairs of colliding geoms of different bodies whose boxes along the world's axes overlap."""
    solid = np.flatnonzero((model.geom_contype | model.geom_conaffinity) != 0)
    middle, half = np.split(model.geom_aabb[solid].reshape(-1, 6), 2, axis=1)
    turn = data.geom_xmat[solid].reshape(-1, 3, 3)
    center = data.geom_xpos[solid] + np.einsum("nij,nj->ni", turn, middle)
    reach = np.einsum("nij,nj->ni", np.abs(turn), half) + model.geom_margin[solid, None]
    body = model.body_weldid[model.geom_bodyid[solid]]
    count = 0
    for start in range(0, len(solid), _ROWS):
        own = np.s_[start : start + _ROWS]
        near = (np.abs(center[own, None] - center[None]) <= reach[own, None] + reach[None]).all(axis=2)
        count += int((near & (body[own, None] != body[None])).sum())
    return count // 2


def _round_up(count: int) -> int:
    return max(1, -(-count // _STEP)) * _STEP
