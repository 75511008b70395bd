"""Cost of a mesh's placement against one view: the Chamfer distance for a partial view (paper section 3.1).

From each observed point to the mesh; and from the mesh to where it could hide, as far as it reaches into space that was
seen to be empty. What nothing was seen of is free.
"""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Points
from tableverse_factory.geometry.registration.icp import Fit, PartialView, SampledMesh, subsample

BODY_POINTS = 300
UPRIGHT = 0.9  # cosine of the tilt up to which a mesh stands on its own lower face
ODD_PRICE_M = 0.001  # a mesh that lies on another than its own lower face has to fit this much better
PROPORTIONS_STD = 0.04  # of a mesh model's proportions: of the logarithm of the size along an axis against the others
STRETCHED_M = 0.0001  # price of proportions that are wrong by one standard deviation
FARTHEST_M = 0.02
FLOATS, KNOWN_SUPPORT_M = 0.1, 0.005  # price of a metre between mesh and support, and how well it must be known
EMPTY_WEIGHT, EMPTY_SLACK_M = 2.0, 0.002
BELOW_TABLE_M = 0.003


def compute_chamfer_costs(
    mesh: SampledMesh, view: PartialView, fits: Sequence[Fit], points: Points
) -> Float64[np.ndarray, " n"]:
    """Chamfer distance of one or more fits from those points of a view that count, and the price of odd stands [m]."""
    turns, sizes = np.stack([fit.rotation for fit in fits]), np.stack([fit.size for fit in fits])
    shifts = np.stack([fit.shift for fit in fits])
    overall = sizes.mean(axis=1)
    local = ((points - shifts[:, None]) @ turns / sizes[:, None]).reshape(-1, 3)
    there = mesh.tree.query(local, distance_upper_bound=FARTHEST_M / float(overall.min()))[0]
    price = np.minimum(there.reshape(len(fits), -1) * overall[:, None], FARTHEST_M).mean(axis=1)
    few = subsample(mesh.points, BODY_POINTS)
    body = (few * sizes[:, None]) @ turns.transpose(0, 2, 1) + shifts[:, None]
    price += np.clip(-body[..., 2] - BELOW_TABLE_M, 0.0, FARTHEST_M).mean(axis=1)
    floats = np.minimum(np.abs(body[..., 2].min(axis=1) - view.support_z), FARTHEST_M)
    price += FLOATS * floats * min(1.0, KNOWN_SUPPORT_M / view.support_std_m)
    empty = view.emptiness(body.reshape(-1, 3)).reshape(len(fits), -1)
    price += EMPTY_WEIGHT * np.clip(-empty - EMPTY_SLACK_M, 0.0, FARTHEST_M).mean(axis=1)
    stretch = np.log(sizes) - np.log(sizes).mean(axis=1, keepdims=True)
    price += STRETCHED_M * (stretch**2).sum(axis=1) / PROPORTIONS_STD**2
    return price + np.where(turns[:, 2, 2] > UPRIGHT, 0.0, ODD_PRICE_M)
