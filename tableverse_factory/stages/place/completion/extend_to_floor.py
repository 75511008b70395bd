"""Extension of long objects that lean in a container: the hidden end is drawn out to the floor."""

import numpy as np
from manifold3d import Manifold

from schemas.geometry import Points, Pose, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.geometry.mesh.voxel_solids import from_manifold, to_manifold

END_SHARE = 0.15  # share of the length over which the thickness of the lower end is measured
RADIUS_RANGE_M = (0.002, 0.008)
MIN_GAP_M = 0.008
MIN_SLOPE = 0.4
OVERLAP_M = 0.01


def extend_to_floor(mesh: TriangleMesh, pose: Pose, points: Points, support_z: float) -> TriangleMesh:
    """Extend the mesh down to `support_z` along the direction in which its points spread; in its own frame.

    Unchanged where it reaches there already, or is too flat to tell where its end would be.
    """
    vertices = transform_points(pose, mesh.vertices)
    gap = float(vertices[:, 2].min()) - support_z
    _, _, directions = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)
    down = -directions[0] if directions[0, 2] > 0.0 else directions[0]
    if gap < MIN_GAP_M or -down[2] < MIN_SLOPE:
        return mesh
    along = vertices @ down
    end = vertices[along > along.max() - END_SHARE * float(np.ptp(along))]
    middle = end.mean(axis=0)
    across = (end - middle) - np.outer((end - middle) @ down, down)
    radius = float(np.clip(np.linalg.norm(across, axis=1).mean(), *RADIUS_RANGE_M))
    start = middle + down * (float(along.max()) - OVERLAP_M - float(middle @ down))
    tip = start + down * ((support_z + radius - start[2]) / down[2])
    ball = Manifold.sphere(radius, 12)
    stem = Manifold.batch_hull([ball.translate(tuple(start)), ball.translate(tuple(tip))])
    try:
        joined = to_manifold(TriangleMesh(vertices, mesh.faces)) + stem
        if len(joined.decompose()) != 1:
            return mesh
        whole = from_manifold(joined)
    except GeometryError:
        return mesh
    return TriangleMesh(transform_points(invert_pose(pose), whole.vertices), whole.faces)
