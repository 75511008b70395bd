"""A ball dropped into a container: tells open vessels from those that their convex pieces close."""

from collections.abc import Sequence

import mujoco
import numpy as np
from scipy.ndimage import distance_transform_edt

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.mesh.height_maps import measure_inscribed_width
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.relations.containers import make_hollow_vessel
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.mjcf.spec import TABLE, make_scene_body, make_simulation_spec
from tableverse_factory.physics.simulate.at_rest import simulate_to_rest

PROBE_SHARE = 0.2
"""Diameter of the probe over the width of the opening."""
MAX_PROBE_RADIUS_M = 0.01
FLAT_M = 0.003
PROBE_TIME_S = 3.0
PROBE_TIMESTEP_S = 0.002
PROBE_DENSITY_KG_M3 = 1000.0


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
    container = make_scene_body("container", mesh, tuple(hulls), scale, 1.0, pose)
    standing = place_mesh(mesh, pose, scale)
    holder = make_hollow_vessel(standing)
    cavity, heights = holder.body.cavity, holder.body.heights
    if cavity is None:
        raise GeometryError("the mesh has no cavity that opens upwards as it stands")
    deepest = _deepest_cell(cavity.cells, heights.top)
    radius = min(PROBE_SHARE * measure_inscribed_width(cavity.cells, heights.cell) / 2, MAX_PROBE_RADIUS_M)
    spec = make_simulation_spec([container], Slab(np.zeros(2), np.ones(2), 0.0, (0, 0, 0)), PROBE_TIMESTEP_S)
    spec.delete(spec.body(TABLE))
    spec.delete(spec.joint(container.object_id))
    start = np.array([*((deepest + heights.corner + 0.5) * heights.cell), cavity.rim_z + 1.5 * radius])
    ball = spec.worldbody.add_body(name="probe", pos=start)
    ball.add_freejoint(name="probe")
    geom = ball.add_geom(spec.find_default("collision"), type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[radius, 0, 0])
    geom.density = PROBE_DENSITY_KG_M3
    rest = simulate_to_rest(
        spec.compile(), PROBE_TIME_S, gentle=True, lost_below_m=float(standing.vertices[:, 2].min()) - 0.05
    )
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
