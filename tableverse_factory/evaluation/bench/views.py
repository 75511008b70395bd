"""Objects on a large table as a noisy depth camera sees them, with their true masks."""

from collections.abc import Sequence

import numpy as np

from schemas.geometry import Camera, TriangleMesh, Vector3
from schemas.identity import object_id
from schemas.objects import PerceivedObject, PerceivedObjects, Table
from schemas.observation import Observation
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.physics.render.render import look_at, render

CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
DISTANCE_M = 0.7
NOISE_M = 0.001
TABLE_HALF_M = 1.0


def seen_on_table(
    meshes: Sequence[TriangleMesh], azimuth: float, elevation: float, rng: np.random.Generator, noise_m: float = NOISE_M
) -> PerceivedObjects:
    """One view of meshes that stand in the table frame, instance ids 1, 2 and so on.

    Args:
        meshes: In the table frame [m].
        azimuth: Where the camera stands, about z, seen from the middle of the objects [rad].
        elevation: How high, above the horizon [rad].
        rng: Of the noise.
        noise_m: Standard deviation of the depth [m].
    """
    every = np.concatenate([mesh.vertices for mesh in meshes])
    target: Vector3 = (every.min(axis=0) + every.max(axis=0)) / 2
    away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    camera_to_table = look_at(target + DISTANCE_M * away, target)
    corners = TABLE_HALF_M * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    table = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))
    seen = render([table, *meshes], CAMERA, camera_to_table, shadows=False)
    noise = rng.normal(0.0, noise_m, seen.depth.shape)
    depth = np.where(seen.depth > 0.0, seen.depth + noise, 0.0).astype(np.float32)
    ids = np.where(seen.ids == 0, -1, np.maximum(seen.ids, 0)).astype(np.int32)
    points = backproject(depth, CAMERA)
    objects = tuple(
        PerceivedObject(object_id(k), k + 1, "object", 1.0, points[ids == k + 1], seen.color[ids == k + 1])
        for k in range(len(meshes))
    )
    plane = Table(np.zeros(2), np.full(2, TABLE_HALF_M), 0.0, (128, 128, 128), noise_m)
    observation = Observation("view", seen.color, depth, CAMERA)
    return PerceivedObjects("view", observation, camera_to_table, plane, ids, objects, "view")
