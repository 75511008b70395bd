"""Who carries whom by force: what a simulation at rest says, in the truth and in a result alike."""

from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float64

from schemas.config import SettleConfig
from schemas.geometry import Pose
from tableverse_factory.evaluation.bench.layouts import Case
from tableverse_factory.evaluation.bench.release import ReleasedScene, at_rest, scene_at
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.relations.support import Pairs
from tableverse_factory.physics.simulate.at_rest import free_bodies, quiet_data

LEAST_SHARE = 0.1
"""A thing is carried by another whose contact forces bear at least this share of its weight."""
MEAN_OVER_S = 0.1
"""Forces are averaged over so much time: what rests on an edge is borne now by this, now by that piece [s]."""
TRUE_REST_M = 0.005
"""What comes to rest further than this from where it truly rests cannot stand there on its convex pieces: of such
things the truth is not known by force [m]."""


@dataclass(frozen=True, slots=True)
class TrueCarrying:
    """Who carries whom by force where the things of a layout truly rest.

    Attributes:
        pairs: Pairs (carried, carrier), indices of objects.
        left_out: How many more there are of which either moved by more than `TRUE_REST_M` until it rested.
    """

    pairs: Pairs
    left_out: int


def carried_by_force(scene: ReleasedScene, timestep_s: float) -> Pairs:
    """Pairs (carried, carrier) in a scene at rest: the upward part of their contact force bears a share of the weight.

    Leaning counts as far as it bears weight, by friction too; what only touches does not.
    """
    shares = _borne(scene.model(timestep_s), round(MEAN_OVER_S / timestep_s))
    return frozenset((int(i), int(j)) for i, j in np.argwhere(shares >= LEAST_SHARE))


def truly_carried(case: Case, config: SettleConfig) -> TrueCarrying | None:
    """Who carries whom where things truly rest; None where that is not known of every object, or they find no rest.

    The truth is settled first, because its contacts are a matter of a tenth of a millimetre; pairs of which either
    moves by more than `TRUE_REST_M` are left out, for all methods alike.
    """
    if case.relations is None:
        return None
    rests = [case.truth[placed.object_id] for placed in case.item.objects]
    objects = tuple(
        replace(placed, pose=pose, scale=scale) for placed, (pose, scale) in zip(case.item.objects, rests, strict=True)
    )
    truth = scene_at(replace(case.item, objects=objects), case.pieces, [pose for pose, _ in rests])
    settled, resting = at_rest(truth, config, gentle=True)
    if not resting:
        return None
    moved = [
        _moved_m(body.properties.center, body.pose, pose)
        for body, pose in zip(truth.bodies, settled.poses, strict=True)
    ]
    pairs = carried_by_force(settled, config.timestep_s)
    known = frozenset((i, j) for i, j in pairs if max(moved[i], moved[j]) <= TRUE_REST_M)
    return TrueCarrying(known, len(pairs) - len(known))


def _borne(model: mujoco.MjModel, steps: int) -> Float64[np.ndarray, "n n"]:
    """Of the weight of each free body the share that each other one bears."""
    data, bodies = quiet_data(model), free_bodies(model)
    place = {body: k for k, body in enumerate(bodies)}
    lifted, wrench = np.zeros((len(bodies), len(bodies))), np.zeros(6)
    for _ in range(steps):
        mujoco.mj_step(model, data)
        for k in range(data.ncon):
            contact = data.contact[k]
            first, second = (place.get(int(model.geom_bodyid[geom])) for geom in contact.geom)
            if first is None or second is None:
                continue
            mujoco.mj_contactForce(model, data, k, wrench)
            upward = float(contact.frame.reshape(3, 3)[:, 2] @ wrench[:3])  # from the first onto the second
            lifted[second, first] += upward
            lifted[first, second] -= upward
    weights = model.body_mass[bodies] * float(np.linalg.norm(model.opt.gravity))
    shares: Float64[np.ndarray, "n n"] = lifted / steps / weights[:, None]
    return shares


def _moved_m(center: np.ndarray, before: Pose, after: Pose) -> float:
    """How far a point of a body has moved [m]."""
    return float(np.linalg.norm(transform_points(after, center[None]) - transform_points(before, center[None])))
