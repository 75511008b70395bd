"""Silhouettes of the objects of a twin against the masks of its photograph."""

from collections.abc import Sequence

import numpy as np

from schemas.geometry import Camera, IdImage, Pose, TriangleMesh
from schemas.scene import Coverage
from tableverse_factory.physics.render.raycast import Raycaster

MAX_PIXELS = 320_000  # of the picture as coverage is measured


def compare_silhouettes(masks: IdImage, shown: IdImage) -> dict[int, float]:
    """Compute the IoU of each id above 0 in the masks of a photograph and in the objects that the twin shows."""
    photographed, drawn, shared = (_count_pixels(its) for its in (masks, shown, masks[masks == shown]))
    return {
        value: shared.get(value, 0) / (photographed.get(value, 0) + drawn.get(value, 0) - shared.get(value, 0))
        for value in sorted({*photographed, *drawn})
    }


def measure_coverage(
    masks: IdImage, values: Sequence[int | None], meshes: Sequence[TriangleMesh], camera: Camera, camera_to_world: Pose
) -> Coverage:
    """Measure how meshes in the world frame cover their masks, seen from the camera that the masks belong to.

    `values` holds the id of each mesh in the masks; None for one without a mask, which may hide others.
    """
    stride = int(np.ceil(np.sqrt(masks.size / MAX_PIXELS)))
    masks = masks[::stride, ::stride]
    fx, fy, cx, cy = (value / stride for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    thin = Camera(fx, fy, cx, cy, masks.shape[1], masks.shape[0])
    hits = Raycaster(meshes).cast(thin, camera_to_world)
    shown = np.zeros(masks.size, dtype=np.int32)
    shown[hits.pixels] = np.array([value or 0 for value in values], dtype=np.int32)[hits.part]
    covered, seen = (_count_pixels(its) for its in (masks[masks == shown.reshape(masks.shape)], masks))
    return Coverage(
        sum(covered.values()) / max(sum(seen.values()), 1),
        tuple(None if v is None or v not in seen else covered.get(v, 0) / seen[v] for v in values),
    )


def _count_pixels(image: np.ndarray) -> dict[int, int]:
    values, counts = np.unique(image[image > 0], return_counts=True)
    return dict(zip(values.tolist(), counts.tolist(), strict=True))
