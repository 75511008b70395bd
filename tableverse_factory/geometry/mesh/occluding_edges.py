"""Edges of a surface in a picture behind which it goes on: the rim of a cup before its floor."""

import numpy as np
from scipy import ndimage

from schemas.geometry import Camera, Mask, Pose
from tableverse_factory.geometry.mesh.raycasting import RaycastingScene, pack_pixel_rays

EDGE_SHARE = 0.03  # of an object's size in the picture, by which a shape fitted to estimated depth misses its edges
STEP_M = 0.01  # least change of the depth across an edge [m]
# The same in widths of a pixel, over three rows and columns: of a surface at 79 degrees to the picture it is as much.
STEP_PIXELS = 14.0


def find_behind_edges(scene: RaycastingScene, camera: Camera, camera_to_scene: Pose, own: Mask) -> Mask:
    """Find the pixels whose surface goes on behind an edge near them, shape (h, w): the edge may show there.

    Near is by `EDGE_SHARE` of the size of what the pixels `own` show.
    """
    reach = max(1, round(EDGE_SHARE * float(np.sqrt(own.sum()))))
    depth = scene.cast_rays(pack_pixel_rays(camera, camera_to_scene), nthreads=1)["t_hit"].numpy()
    met = np.where(np.isfinite(depth), depth, -np.inf)
    nearest, farthest = ndimage.minimum_filter(depth, 3), ndimage.maximum_filter(met, 3)
    edges = farthest - nearest > np.maximum(STEP_M, STEP_PIXELS / camera.fx * nearest)
    near = ndimage.maximum_filter(edges, 2 * reach - 1)  # those edges are three pixels wide
    size = 2 * reach + 1
    with np.errstate(invalid="ignore"):  # nothing is met
        middle = (ndimage.minimum_filter(depth, size) + ndimage.maximum_filter(met, size)) / 2.0
        behind: Mask = near & (met > middle)
    return behind
