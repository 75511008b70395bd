"""Isolated free fall of contents into a container that stands still.

The bodies keep a gap from one another, as MuJoCo's contacts act at the sum of the margins of two geoms. An assembled
composite is then as free as rectification requires, and settling closes the gaps.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.mjcf.spec import TABLE, SceneBody, make_simulation_spec
from tableverse_factory.physics.simulate.at_rest import Rest, simulate_to_rest

# Of contents that are shaken down: at the friction of everyday surfaces they bridge the void below.
SLIPPERY_FRICTION, SLIPPERY_ROLLING_FRICTION = 0.1, 0.001
LOST_BELOW_M = 0.05  # a body that sinks this far below all fixed ones has missed them
_EMPTY_SLAB = Slab(np.zeros(2), np.ones(2), 0.0, (0, 0, 0))


def simulate_fall(
    fixed: Sequence[SceneBody],
    falling: Sequence[SceneBody],
    *,
    gap_m: float,
    timestep_s: float,
    max_time_s: float,
    slippery: bool = False,
) -> Rest:
    """Let bodies fall, gently at first, until they rest on the fixed ones or on one another; returns them in order.

    Args:
        fixed: Stand still where they are.
        falling: At first free of all others by `gap_m`.
        gap_m: Kept between the pieces of any two bodies [m].
        timestep_s: Step of the simulation [s].
        max_time_s: Bound on simulated time [s]; it also ends when a body misses the fixed ones.
        slippery: With almost no friction, as if the container were shaken.
    """
    if slippery:
        fixed, falling = [_make_slippery(body) for body in fixed], [_make_slippery(body) for body in falling]
    spec = make_simulation_spec([*fixed, *falling], _EMPTY_SLAB, timestep_s)
    spec.delete(spec.body(TABLE))
    for body in fixed:
        spec.delete(spec.joint(body.object_id))
    for geom in spec.geoms:
        geom.margin = gap_m / 2
    foot = min(float(place_mesh(body.mesh, body.pose).vertices[:, 2].min()) for body in fixed)
    return simulate_to_rest(spec.compile(), max_time_s, gentle=True, lost_below_m=foot - LOST_BELOW_M)


def _make_slippery(body: SceneBody) -> SceneBody:
    return replace(body, friction=SLIPPERY_FRICTION, rolling_friction=SLIPPERY_ROLLING_FRICTION)
