"""Training samples: inputs and targets of the network from augmented views (noise, lost pixels, tilt, scale)."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Float64
from scipy import ndimage

from schemas.geometry import Frozen, IdImage, Mask
from tableverse_factory.evaluation.training.views import TrainingView
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.transforms import quaternion_from_rotation_vector, rotation_matrix
from tableverse_factory.stages.perceive.learned.features import OFFSET_UNIT_M, compute_features
from tableverse_factory.stages.perceive.learned.net_format import THINNING

TILT_RAD = 0.012
LIFT_M = 0.002
BEND_M = 0.003
SCALE_RANGE = (0.85, 1.2)
SHIFT_M = 0.1
NOISE = 0.0006
LOST_SHARE = 0.5
MAX_HOLES = 12


@dataclass(frozen=True, slots=True, eq=False)
class TrainingBatch(Frozen):
    """Samples of one step."""

    inputs: Float32[np.ndarray, "b 7 h w"]  # features of `learned.features`
    is_object: Float32[np.ndarray, "b h2 w2"]  # whether the output pixel belongs to an object
    offsets: Float32[np.ndarray, "b 3 h2 w2"]  # to the mean of its object's visible points [OFFSET_UNIT_M]; else 0
    counted: Float32[np.ndarray, "b h2 w2"]  # weight in the objectness loss: 0 without a reading
    share: Float32[np.ndarray, "b h2 w2"]  # weight in the offset loss; those of one object sum to 1


def make_batch(views: list[TrainingView], rng: np.random.Generator) -> TrainingBatch:
    """Make a batch of augmented views."""
    samples = [_make_sample(view, rng) for view in views]
    return TrainingBatch(*(np.stack(arrays) for arrays in zip(*samples, strict=True)))


def _make_sample(view: TrainingView, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    flipped = bool(rng.random() < 0.5)
    depth, points = _augment_view(view, rng)
    valid, ids = depth > 0, view.ids.astype(np.int32)
    on_objects = points[valid & (ids > 0)]
    center = np.median(on_objects[:, :2], axis=0) if len(on_objects) else np.zeros(2)
    points[..., :2] -= center
    if flipped:
        points, valid, ids = points[:, ::-1] * [-1.0, 1.0, 1.0], valid[:, ::-1], ids[:, ::-1]
    inputs = compute_features(points, valid, rng.normal(0.0, SHIFT_M, 2))
    thin = np.s_[::THINNING, ::THINNING]
    return (inputs, *_make_targets(points[thin], valid[thin], ids[thin]))


def _make_targets(
    points: Float64[np.ndarray, "h w 3"], valid: Mask, ids: IdImage
) -> tuple[Float32[np.ndarray, "*shape"], ...]:
    """Make objectness, offsets, and both weights, as in `TrainingBatch`."""
    seen = np.where(valid, ids, 0)
    sizes = np.bincount(seen.ravel())
    sums = np.stack([np.bincount(seen.ravel(), points[..., k].ravel()) for k in range(3)], axis=1)
    centers = sums / np.maximum(sizes, 1)[:, None]
    offsets = np.where((seen > 0)[..., None], (centers[seen] - points) / OFFSET_UNIT_M, 0.0)
    share = np.where(seen > 0, 1.0 / np.maximum(sizes, 1)[seen], 0.0)
    wanted = (seen > 0, np.moveaxis(offsets, -1, 0), valid, share)
    return tuple(np.asarray(array, dtype=np.float32) for array in wanted)


def _augment_view(
    view: TrainingView, rng: np.random.Generator
) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w 3"]]:
    """Add noise and lost pixels to the depth [m], and a plane error, bend and scale to its points [m]."""
    depth = view.depth * view.depth_scale
    noise = ndimage.gaussian_filter(rng.standard_normal(depth.shape), 1.0) * 3.5 + rng.standard_normal(depth.shape)
    depth = np.where(depth > 0, depth + rng.uniform(0.0, NOISE) * depth**2 * noise, 0.0)
    if rng.random() < LOST_SHARE:
        depth[_choose_lost_pixels(rng, depth.shape)] = 0.0
    to_table = view.camera_to_table
    points = backproject(depth, view.camera) @ to_table[:3, :3].T + to_table[:3, 3]
    tilt = rotation_matrix(quaternion_from_rotation_vector(np.append(rng.normal(0.0, TILT_RAD, 2), 0.0)))
    turned = rotation_matrix(quaternion_from_rotation_vector(np.array([0.0, 0.0, _compute_heading(to_table)])))
    points = points @ (tilt @ turned).T
    reach = points[..., :2] / 0.5
    bend = rng.normal(0.0, BEND_M, 3)
    bent = bend[0] * reach[..., 0] ** 2 + bend[1] * reach[..., 1] ** 2 + bend[2] * reach[..., 0] * reach[..., 1]
    points[..., 2] += np.clip(bent, -3 * BEND_M, 3 * BEND_M) + rng.normal(0.0, LIFT_M)
    return depth, points * rng.uniform(*SCALE_RANGE)


def _compute_heading(camera_to_table: Float64[np.ndarray, "4 4"]) -> float:
    """Compute the turn about z that aligns the right of the camera with x, as in `perceive` [rad]."""
    right = camera_to_table[:2, 0]
    return -float(np.arctan2(right[1], right[0]))


def _choose_lost_pixels(rng: np.random.Generator, shape: tuple[int, ...]) -> Bool[np.ndarray, "h w"]:
    """Choose a few patches and single pixels."""
    lost: Bool[np.ndarray, "h w"] = rng.random(shape) < rng.uniform(0.0, 0.05)
    for _ in range(int(rng.integers(MAX_HOLES + 1))):
        row, column = (int(rng.integers(size)) for size in shape)
        height, width = (int(v) for v in rng.integers(1, 9, 2))
        lost[row : row + height, column : column + width] = True
    return lost
