"""Visible share of each object of a synthetic scene."""

from collections.abc import Sequence

import numpy as np

from schemas.geometry import Camera, IdImage, Pose, TriangleMesh
from tableverse_factory.physics.render.raycast import Raycaster

SUBSAMPLING = 2
"""Silhouettes are counted on every second pixel each way, over a view twice as wide and high as the picture."""


def measure_visibility(
    ids: IdImage, objects: Sequence[TriangleMesh], camera: Camera, camera_to_table: Pose
) -> tuple[np.ndarray, np.ndarray]:
    """Measure visible pixels of each object, and their share of its silhouette in 0–1. Both of shape (n,).

    What the edge of the picture cuts off counts as hidden.

    Args:
        ids: Index of the object at each pixel; -1 or anything beyond the objects elsewhere.
        objects: In the table frame [m].
        camera: Intrinsics.
        camera_to_table: Pose of the camera.
    """
    wide = Camera(
        camera.fx / SUBSAMPLING,
        camera.fy / SUBSAMPLING,
        camera.cx / SUBSAMPLING + camera.width / 4,
        camera.cy / SUBSAMPLING + camera.height / 4,
        camera.width,
        camera.height,
    )
    _, parts = Raycaster(objects).covered(wide, camera_to_table)
    alone = np.bincount(parts, minlength=len(objects)) * float(SUBSAMPLING**2)
    seen = np.bincount(ids[(ids >= 0) & (ids < len(objects))], minlength=len(objects))
    return seen, np.clip(seen / np.maximum(alone, 1.0), 0.0, 1.0)
