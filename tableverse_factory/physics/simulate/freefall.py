"""Isolated free fall: what is dropped into a container that stands still, and nothing else around.

The bodies keep a gap from one another: MuJoCo's contacts act at the sum of the margins of two geoms, so that what
rests on something rests a gap above it. An assembled composite is then as free as rectification wants it, and settling
closes the gaps.
"""

from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from scipy.ndimage import distance_transform_edt

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.mesh.height_maps import inscribed_width
from tableverse_factory.geometry.mesh.meshes import placed_mesh
from tableverse_factory.geometry.relations.containers import holder_of
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.mjcf.spec import TABLE, SceneBody, scene_body, scene_spec
from tableverse_factory.physics.simulate.at_rest import Rest, simulate_to_rest

SLIPPERY_FRICTION, SLIPPERY_ROLLING_FRICTION = 0.1, 0.001
"""Of things that are shaken down rather than laid: at the friction of everyday surfaces they bridge the void below."""

LOST_BELOW_M = 0.05
"""What sinks this far below everything that stands still has missed it."""

PROBE_SHARE = 0.2
"""Diameter of the probe over the width of the opening."""
MAX_PROBE_RADIUS_M = 0.01
FLAT_M = 0.003
PROBE_TIME_S = 3.0
PROBE_TIMESTEP_S = 0.002
PROBE_DENSITY_KG_M3 = 1000.0
_NOWHERE = Slab(np.zeros(2), np.ones(2), 0.0, (0, 0, 0))


def fall(
    fixed: Sequence[SceneBody],
    falling: Sequence[SceneBody],
    *,
    gap_m: float,
    timestep_s: float,
    max_time_s: float,
    slippery: bool = False,
) -> Rest:
    """Lets bodies fall, gently at first, until they rest on the fixed ones or on one another.

    Args:
        fixed: Stand still where they are.
        falling: Free of everything by `gap_m`, at first.
        gap_m: Kept between the pieces of any two bodies [m].
        timestep_s: Step of the simulation [s].
        max_time_s: Bound on simulated time [s]; it also ends when something falls past all that stands still.
        slippery: With next to no friction, as if the container were shaken.

    Returns:
        How it ended, with the poses of the falling bodies in their order.
    """
    if slippery:
        fixed, falling = [_slippery(body) for body in fixed], [_slippery(body) for body in falling]
    spec = _spec(fixed, falling, gap_m, timestep_s)
    return simulate_to_rest(spec.compile(), max_time_s, gentle=True, lost_below_m=_lost_below(fixed))


def holds_probe(mesh: TriangleMesh, hulls: Sequence[TriangleMesh], pose: Pose, scale: float = 1.0) -> bool:
    """Whether a small ball dropped into a container over the deepest point of its cavity comes to rest in it.

    The cavity is that of the mesh, the contact is with the convex pieces: pieces that close a cup do not pass.

    Args:
        mesh: The container, in its own frame.
        hulls: Its convex pieces, same frame.
        pose: How it stands, its opening upwards.
        scale: Of mesh and pieces.

    Raises:
        GeometryError: if no piece is thick enough to simulate, or the mesh as it stands has no cavity.
    """
    container = scene_body("container", mesh, tuple(hulls), scale, 1.0, pose)
    holder = holder_of(placed_mesh(mesh, pose, scale))
    cavity, heights = holder.body.cavity, holder.body.heights
    if cavity is None:
        raise GeometryError("the mesh has no cavity that opens upwards as it stands")
    deepest = _deepest_cell(cavity.cells, heights.top)
    radius = min(PROBE_SHARE * inscribed_width(cavity.cells, heights.cell) / 2, MAX_PROBE_RADIUS_M)
    spec = _spec([container], [], 0.0, PROBE_TIMESTEP_S)
    start = np.array([*((deepest + heights.corner + 0.5) * heights.cell), cavity.rim_z + 1.5 * radius])
    ball = spec.worldbody.add_body(name="probe", pos=start)
    ball.add_freejoint(name="probe")
    geom = ball.add_geom(spec.find_default("collision"), type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0])
    geom.density = PROBE_DENSITY_KG_M3
    rest = simulate_to_rest(spec.compile(), PROBE_TIME_S, gentle=True, lost_below_m=_lost_below([container]))
    center = rest.poses[0].position
    i, j = (int(np.floor(center[k] / heights.cell)) - heights.corner[k] for k in range(2))
    nx, ny = cavity.opening.shape
    within = 0 <= i < nx and 0 <= j < ny and bool(cavity.opening[i, j])
    return within and bool(center[2] + radius < cavity.rim_z)


def _deepest_cell(cavity: np.ndarray, top: np.ndarray) -> np.ndarray:
    """The cell over the floor of a cavity, within `FLAT_M` of its lowest, that is furthest from the wall."""
    lowest = top[cavity].min()
    room = distance_transform_edt(np.pad(cavity, 1))[1:-1, 1:-1]
    room[~cavity | (top > lowest + FLAT_M)] = 0.0
    return np.array(np.unravel_index(int(np.argmax(room)), room.shape))


def _spec(fixed: Sequence[SceneBody], falling: Sequence[SceneBody], gap_m: float, timestep_s: float) -> mujoco.MjSpec:
    spec, _ = scene_spec([*fixed, *falling], _NOWHERE, timestep_s=timestep_s, visuals=False)
    spec.delete(spec.body(TABLE))
    for body in fixed:
        spec.delete(spec.joint(body.object_id))
    for geom in spec.geoms:
        geom.margin = gap_m / 2
    return spec


def _slippery(body: SceneBody) -> SceneBody:
    return replace(body, friction=SLIPPERY_FRICTION, rolling_friction=SLIPPERY_ROLLING_FRICTION)


def _lost_below(fixed: Sequence[SceneBody]) -> float:
    foot = min(float(placed_mesh(body.mesh, body.pose).vertices[:, 2].min()) for body in fixed)
    return foot - LOST_BELOW_M
