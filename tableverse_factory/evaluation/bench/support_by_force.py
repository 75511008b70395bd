"""Support by contact force, measured in a simulation at rest: of the truth and of a result alike."""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float64

from schemas.config import SettleConfig
from schemas.geometry import Pose
from tableverse_factory.evaluation.bench.free_simulation import ReleasedScene, make_scene, simulate_to_rest
from tableverse_factory.evaluation.bench.layouts import LayoutCase
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.relations.support import Pairs
from tableverse_factory.physics.simulate.at_rest import find_free_bodies, make_quiet_data

LEAST_SHARE = 0.1  # an object is carried by another whose contact forces bear at least this share of its weight
MEAN_OVER_S = 0.1  # time over which forces are averaged: an object on an edge rests on changing pieces [s]
TRUE_REST_M = 0.005
"""An object that settles further than this from its true pose cannot stand there on its pieces: unknown [m]."""


@dataclass(frozen=True, slots=True)
class TrueSupport:
    """Support by force among the objects of a layout at their true rest poses."""

    pairs: Pairs  # (carried, carrier), indices of objects
    left_out: int  # further pairs of which either moved by more than `TRUE_REST_M` until it rested


def find_support_by_force(scene: ReleasedScene, timestep_s: float) -> Pairs:
    """Find pairs (carried, carrier) of a scene at rest by their upward contact forces, friction included."""
    shares = _measure_borne_shares(scene.model(timestep_s), round(MEAN_OVER_S / timestep_s))
    return frozenset((int(i), int(j)) for i, j in np.argwhere(shares >= LEAST_SHARE))


def find_true_support(case: LayoutCase, config: SettleConfig) -> TrueSupport | None:
    """Find the support by force at the true rest poses; None if they are not all known, or do not come to rest.

    The truth is settled first, because its contacts are accurate to a tenth of a millimetre.
    """
    if case.relations is None:
        return None
    rests = [case.truth[placed.object_id] for placed in case.item.objects]
    objects = tuple(
        replace(placed, pose=pose, scale=scale) for placed, (pose, scale) in zip(case.item.objects, rests, strict=True)
    )
    truth = make_scene(replace(case.item, objects=objects), case.pieces, [pose for pose, _ in rests])
    settled, resting = simulate_to_rest(truth, config, gentle=True)
    if not resting:
        return None
    moved = [
        _measure_motion(body.properties.center, body.pose, pose)
        for body, pose in zip(truth.bodies, settled.poses, strict=True)
    ]
    pairs = find_support_by_force(settled, config.timestep_s)
    known = frozenset((i, j) for i, j in pairs if max(moved[i], moved[j]) <= TRUE_REST_M)
    return TrueSupport(known, len(pairs) - len(known))


def _measure_borne_shares(model: mujoco.MjModel, steps: int) -> Float64[np.ndarray, "n n"]:
    """Measure the share of the weight of each free body (row) that each other one (column) bears."""
    data, bodies = make_quiet_data(model), find_free_bodies(model)
    index = {body: k for k, body in enumerate(bodies)}
    lifted, wrench = np.zeros((len(bodies), len(bodies))), np.zeros(6)
    for _ in range(steps):
        mujoco.mj_step(model, data)
        for k in range(data.ncon):
            contact = data.contact[k]
            first, second = (index.get(int(model.geom_bodyid[geom])) for geom in contact.geom)
            if first is None or second is None:
                continue
            mujoco.mj_contactForce(model, data, k, wrench)
            upward = float(contact.frame.reshape(3, 3)[:, 2] @ wrench[:3])  # from the first onto the second
            lifted[second, first] += upward
            lifted[first, second] -= upward
    weights = model.body_mass[bodies] * float(np.linalg.norm(model.opt.gravity))
    return lifted / steps / weights[:, None]


def _measure_motion(center: np.ndarray, before: Pose, after: Pose) -> float:
    return float(np.linalg.norm(transform_points(after, center[None]) - transform_points(before, center[None])))
