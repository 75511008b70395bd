"""Edges of a surface in a picture behind which it goes on: the rim of a cup before its floor."""

import numpy as np
from scipy import ndimage

from schemas.geometry import Camera, Mask, Pose
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.geometry.mesh.raycasting import RaycastingScene, pack_rays

STEP_M = 0.01  # least change of the depth from a pixel to the next but one: of a surface seen edge-on it is less


def find_behind_edges(scene: RaycastingScene, camera: Camera, camera_to_scene: Pose, reach_px: int) -> Mask:
    """Find the pixels within `reach_px` of an edge, shape (h, w), whose surface goes on behind it."""
    unit = backproject(np.ones((camera.height, camera.width)), camera)
    rays = pack_rays(camera_to_scene.position, unit @ rotation_matrix(camera_to_scene.quaternion_wxyz).T)
    depth = scene.cast_rays(rays, nthreads=1)["t_hit"].numpy()
    met = np.where(np.isfinite(depth), depth, -np.inf)
    edges = ndimage.maximum_filter(met, 3) - ndimage.minimum_filter(depth, 3) > STEP_M
    near = ndimage.maximum_filter(edges, 2 * reach_px - 1)
    behind: Mask = near & (met - ndimage.minimum_filter(depth, 2 * reach_px + 1) > STEP_M)
    return behind
