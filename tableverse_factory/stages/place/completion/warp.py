"""Smooth warp of a thin-walled shape onto the seen surface.

A vessel is fitted as if it were round, and a sheet by its noisy middle. Real ones deviate by a fraction of a
millimetre, as much as a wall is thick. What the depth shows besides, averaged over patches, moves both sides of the
wall together.
"""

import numpy as np
from jaxtyping import Float64
from scipy.spatial import cKDTree

from schemas.geometry import Points, Pose, TriangleMesh
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene, pack_rays
from tableverse_factory.geometry.mesh.voxel_solids import from_manifold, to_manifold
from tableverse_factory.stages.place.completion.ray_misfit import RaySample, compute_mesh_misfit, sample_rays
from tableverse_factory.stages.place.view.object_view import ObjectView

RAYS = 6000  # of the window: 100 to 260 of the object to a patch of a bowl or plate at arm's length
ROUNDS = 2  # the first moves a plate by 0.3 mm, the second by 0.1, a third by 0.04: by less than the readings tell
MAX_SHIFT_M = 0.003  # from the surface to a reading that belongs to it [m]
MIN_FACING = 0.3  # least cosine of incidence
REACH_M = 0.03  # radius of a patch: errors of a sensor agree over millimetres, and would become bumps [m]
NODE_M = 0.004  # readings nearer to each other are one [m]
PRIOR_NODES = 10.0  # a patch whose nodes weigh as much moves by half of what they show
MIN_RAYS = 50  # fewer tell nothing
MAX_EDGE_M, EDGES = 0.01, 40  # longest edge of a mesh that bends, and most such edges along its box [m]
FLAT_M = 1e-4  # deviation up to which vertices are left out afterwards [m]


def warp_to_depth(mesh: TriangleMesh, pose: Pose, view: ObjectView) -> TriangleMesh:
    """Warp a closed mesh, in its own frame [m], to the depth in which its surface was seen.

    Returns a mesh with more vertices, nowhere below the support; the given one where no warp fits the picture better.

    Raises:
        GeometryError: if the mesh bounds no solid, or nothing of it is above the support.
    """
    rays = sample_rays(view, RAYS)
    edge = max(MAX_EDGE_M, float(np.ptp(mesh.vertices, axis=0).max()) / EDGES)
    fine = from_manifold(to_manifold(mesh).refine_to_length(edge))
    vertices = transform_points(pose, fine.vertices)
    for _ in range(ROUNDS):
        at, shift = _measure_shifts(TriangleMesh(vertices, fine.faces), rays)
        if len(at) < MIN_RAYS:
            return mesh
        vertices = vertices + _smooth_shifts(at, shift, vertices)
    solid = to_manifold(TriangleMesh(vertices, fine.faces)).trim_by_plane((0.0, 0.0, 1.0), view.support_z)
    whole = from_manifold(solid.simplify(FLAT_M))
    warped = TriangleMesh(transform_points(invert_pose(pose), whole.vertices), whole.faces)
    better = compute_mesh_misfit(rays, warped, pose) < compute_mesh_misfit(rays, mesh, pose)
    return warped if better else mesh


def _measure_shifts(mesh: TriangleMesh, rays: RaySample) -> tuple[Points, Float64[np.ndarray, "n 3"]]:
    """Measure the shifts along the normals that bring points of the surface to the readings, table frame [m]."""
    count = len(rays.facing)
    directions, end = rays.directions[:, :count].T, rays.end[:count]
    cast = make_raycasting_scene(mesh).cast_rays(pack_rays(rays.eye, directions), nthreads=1)
    hit, normals = cast["t_hit"].numpy().astype(np.float64), cast["primitive_normals"].numpy().astype(np.float64)
    against = -(directions * normals).sum(axis=1)  # speed along a ray towards the surface
    met = np.isfinite(hit) & (end > 0.0) & (against > MIN_FACING * np.linalg.norm(directions, axis=1))
    along = np.where(met, (np.where(met, hit, 0.0) - end) * against, np.inf)
    near = np.abs(along) < MAX_SHIFT_M
    return rays.eye + hit[near, None] * directions[near], along[near, None] * normals[near]


def _smooth_shifts(at: Points, shift: Float64[np.ndarray, "n 3"], vertices: Points) -> Float64[np.ndarray, "k 3"]:
    """Average the shifts of the points `at` about each vertex [m], less where few were seen.

    The weights fall to zero at the reach, so that neighbouring vertices move alike.
    """
    _, node, count = np.unique(np.floor(at / NODE_M), axis=0, return_inverse=True, return_counts=True)
    sums = np.zeros((len(count), 6))
    np.add.at(sums, node.ravel(), np.hstack([at, shift]))
    middle, mean = np.hsplit(sums / count[:, None], 2)
    pairs = cKDTree(vertices).sparse_distance_matrix(cKDTree(middle), REACH_M, output_type="coo_matrix")
    kernel = pairs.tocsr()
    kernel.data = (1.0 - (kernel.data / REACH_M) ** 2) ** 2
    weight = np.asarray(kernel.sum(axis=1)).reshape(-1, 1)
    return np.asarray((kernel @ mean) / (weight + PRIOR_NODES))
