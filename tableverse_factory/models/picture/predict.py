"""Predictions of the net of pictures: depth, table, objects, and how sure it is."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import product

import numpy as np
from jaxtyping import Float32, Float64
from PIL import Image
from scipy.special import expit, softmax

from schemas.geometry import Camera, DepthImage, Frozen, Picture
from schemas.identity import content_hash
from tableverse_factory.geometry.math.camera import backproject, rescale_camera
from tableverse_factory.models.picture.net import MULTIPLE, REACHES, load_picture_net

LEAST_PIXELS, MOST_PIXELS = 76_800, 118_000  # of the net's input: it was trained at 320 x 240 and more
MOST_SENSED_PIXELS = 200_000  # of its input with a sensor's depth, where one look is enough; small objects need them
MIRRORED_SCALE, STRIDE = 7 / 6, 16  # of a bare picture seen once more; the net takes sides that are multiples of 16
OTHER, TABLE, OBJECT = range(3)
_Outputs = dict[str, Float32[np.ndarray, "..."]]
_MAX_LOG_DEPTH = 7.0  # a depth of a kilometre: what exceeds it is no room


@dataclass(frozen=True, slots=True, eq=False)
class PicturePrediction(Frozen):
    """A prediction, at the net's working size (h, w).

    Attributes:
        camera: At this size.
        depth: Distance along the optical axis [m].
        label: Probabilities of `OTHER`, `TABLE` and `OBJECT`.
        votes: From each pixel to the middle of its object, x and y [px].
        boundary: Probability of an edge between objects.
        affinity: Logits that a pixel and the one each of `REACHES` to its right, and below it, are of one object.
        normal: Of the table, towards the camera, in the camera frame; a unit vector.
        distance_m: Of the camera from the table's plane [m].
        table_probability: That a table-top is shown.
        scale_sigma: Standard deviation of the logarithm of the scale.
    """

    camera: Camera
    depth: Float32[np.ndarray, "h w"]
    label: Float32[np.ndarray, "3 h w"]
    votes: Float32[np.ndarray, "2 h w"]
    boundary: Float32[np.ndarray, "h w"]
    affinity: Float32[np.ndarray, "6 h w"]
    normal: Float64[np.ndarray, "3"]
    distance_m: float
    table_probability: float
    scale_sigma: float


_LATEST: dict[str, PicturePrediction] = {}  # of this process, by the hash of the question


def predict_picture(
    color: Picture, camera: Camera, depth: DepthImage | None = None, weights: str = ""
) -> PicturePrediction:
    """Predict from a picture and its camera; with a sensor's `depth` [m], 0 where unknown, the net reads that too.

    A bare picture is seen twice, the second time mirrored and larger, and what both say is averaged.
    The latest prediction is remembered: two stages ask the same of a bare picture, and two detectors of a sensed one.

    Raises:
        WeightsError: if the net of `weights`, empty for the one of this package, cannot be loaded.
        ModelError: if it cannot be run.
    """
    sensed = np.zeros(color.shape[:2], np.float32) if depth is None else np.asarray(depth, np.float32)
    key = content_hash(repr((color.shape, camera, weights)).encode(), color.tobytes(), sensed.tobytes())
    if key not in _LATEST:
        made = _predict(color, camera, sensed, weights)
        _LATEST.clear()
        _LATEST[key] = made
    return _LATEST[key]


def predict_window(
    color: Picture, camera: Camera, depth: DepthImage, window: tuple[slice, slice], weights: str = ""
) -> PicturePrediction:
    """Predict what a sensor shows within a window of rows and columns; `depth` is in metres, 0 where unknown.

    All of the net's pixels go to the window, which is cut to the picture and grows to half of its height and width
    at least. The maps are those of the whole picture, as fine as in the window; outside of it is neither object nor
    table, at the median depth.

    Raises:
        WeightsError, ModelError: as `predict_picture`.
    """
    part = tuple(_grow(own, n) for own, n in zip(window, depth.shape, strict=True))
    corner, size = [own.start for own in part], [own.stop - own.start for own in part]
    own_camera = replace(camera, cx=camera.cx - corner[1], cy=camera.cy - corner[0], width=size[1], height=size[0])
    found = predict_picture(color[part], own_camera, depth[part], weights)
    zoom = np.array(found.depth.shape) / size
    rows, columns = (round(n) for n in np.array(depth.shape) * zoom)
    top, left = (round(start) for start in corner * zoom)

    def surround(map_: np.ndarray, around: np.ndarray | float = 0.0) -> np.ndarray:
        full = np.full((*map_.shape[:-2], rows, columns), around, map_.dtype)
        place = full[..., top : top + map_.shape[-2], left : left + map_.shape[-1]]
        place[...] = map_[..., : place.shape[-2], : place.shape[-1]]
        return full

    return replace(
        found,
        camera=rescale_camera(camera, columns, rows),
        depth=surround(found.depth, float(np.median(found.depth))),
        label=surround(found.label, np.eye(3)[OTHER][:, None, None]),
        votes=surround(found.votes),
        boundary=surround(found.boundary),
        affinity=surround(found.affinity),
    )


def _grow(window: slice, length: int) -> slice:
    """Cut a window to a picture's side and let it grow to half of it."""
    start, stop, _ = window.indices(length)
    size = max(stop - start, length // 2)
    start = min(max(0, start - (size - (stop - start)) // 2), length - size)
    return slice(start, start + size)


def choose_working_size(height: int, width: int, most: int = MOST_PIXELS) -> tuple[int, int]:
    """Choose rows and columns of the net's input: multiples of `MULTIPLE` that change the aspect least.

    Of sizes that change it alike, the largest; sizes have `LEAST_PIXELS` to `most` where the aspect permits.
    """
    wanted = np.log(height / width)
    sizes = _list_sizes(most)
    return min(sizes, key=lambda size: (round(abs(np.log(size[0] / size[1]) - wanted), 2), -size[0] * size[1]))


def _list_sizes(most: int) -> Iterator[tuple[int, int]]:
    steps = range(2 * MULTIPLE, most // MULTIPLE, MULTIPLE)
    return ((rows, columns) for rows in steps for columns in steps if LEAST_PIXELS <= rows * columns <= most)


def compute_rays(camera: Camera) -> Float32[np.ndarray, "3 h w"]:
    """Compute unit directions of the pixels, in the camera frame."""
    rays = np.moveaxis(backproject(np.ones((camera.height, camera.width), np.float32), camera), -1, 0)
    return np.ascontiguousarray(rays / np.linalg.norm(rays, axis=0), dtype=np.float32)


def _predict(color: Picture, camera: Camera, sensed: Float32[np.ndarray, "h w"], weights: str) -> PicturePrediction:
    most = int(np.clip(sensed.size, MOST_PIXELS, MOST_SENSED_PIXELS)) if sensed.any() else MOST_PIXELS
    height, width = color.shape[:2]
    rows, columns = choose_working_size(height, width, most)
    out = _ask(color, camera, sensed, weights, (rows, columns))
    if not sensed.any():  # the errors of the mirrored, larger picture are others: the mean of both is nearer
        larger = round(MIRRORED_SCALE * rows / STRIDE) * STRIDE, round(MIRRORED_SCALE * columns / STRIDE) * STRIDE
        turned = replace(camera, cx=camera.width - 1 - camera.cx)
        out = _average(out, _mirror(_ask(np.ascontiguousarray(color[:, ::-1]), turned, sensed, weights, larger)))
    plane = out["plane"].astype(np.float64)
    return PicturePrediction(
        rescale_camera(camera, columns, rows),
        np.exp(np.minimum(out["log_depth"][0], _MAX_LOG_DEPTH)),
        softmax(out["label"], axis=0),
        out["votes"],
        expit(out["boundary"][0]),
        out["affinity"],
        plane[:3] / max(float(np.linalg.norm(plane[:3])), 1e-9),
        float(plane[3]),
        float(expit(float(out["table"][0]))),
        float(out["log_scale_sigma"][0]),
    )


def _ask(
    color: Picture, camera: Camera, sensed: Float32[np.ndarray, "h w"], weights: str, size: tuple[int, int]
) -> _Outputs:
    """Ask the net about the picture at a size, rows and columns."""
    rays = compute_rays(rescale_camera(camera, size[1], size[0]))
    inputs = {"image": _resize_color(color, *size), "rays": rays, "depth": take_nearest(sensed, *size)[None]}
    return load_picture_net(weights)(inputs)


def _mirror(out: _Outputs) -> _Outputs:
    """Mirror the outputs of the net; what a pixel says of the one to its right, it then says of the one to its left."""
    mirrored = {name: part[..., ::-1] if part.ndim == 3 else part.copy() for name, part in out.items()}
    mirrored["votes"] = mirrored["votes"] * np.array([-1.0, 1.0], np.float32)[:, None, None]
    mirrored["plane"][0] *= -1.0
    pairs = zip(product(REACHES, (1, 0)), mirrored["affinity"], strict=True)
    mirrored["affinity"] = np.stack([np.roll(part, -reach, axis=1) if axis else part for (reach, axis), part in pairs])
    return mirrored


def _average(first: _Outputs, second: _Outputs) -> _Outputs:
    """Average outputs of the net, maps at the size of the first, whose scale is kept; votes shrink with their map."""
    rows, columns = first["label"].shape[1:]
    moved = {name: part if part.ndim == 1 else _resize_map(part, rows, columns) for name, part in second.items()}
    moved["votes"] *= np.float32(columns / second["votes"].shape[2])
    moved["log_depth"] += np.median(first["log_depth"]) - np.median(moved["log_depth"])
    moved["plane"][3] = first["plane"][3]
    return {name: (part + moved[name]) / np.float32(2.0) for name, part in first.items()}


def _resize_map(map_: Float32[np.ndarray, "c h w"], rows: int, columns: int) -> Float32[np.ndarray, "c h2 w2"]:
    """Resize by the mean of the nearest pixels."""
    wanted = (columns, rows), Image.Resampling.BILINEAR
    return np.stack([np.asarray(Image.fromarray(np.ascontiguousarray(each)).resize(*wanted)) for each in map_])


def _resize_color(color: Picture, rows: int, columns: int) -> Float32[np.ndarray, "3 h w"]:
    """Resize to RGB in 0–1: by the mean of the pixels' areas, or between them where the picture is smaller."""
    shrinks = rows <= color.shape[0] and columns <= color.shape[1]
    kind = Image.Resampling.BOX if shrinks else Image.Resampling.BILINEAR
    small = np.asarray(Image.fromarray(np.asarray(color)).resize((columns, rows), kind), dtype=np.float32)
    return np.ascontiguousarray(np.moveaxis(small, -1, 0)) / np.float32(255.0)


def take_nearest(image: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """Take what is nearest to the centre of each pixel of another size: means of depths would lie between surfaces."""
    at = ((np.arange(n) + 0.5) * (full / n) for n, full in zip((rows, columns), image.shape, strict=True))
    return image[np.ix_(*(places.astype(np.intp) for places in at))]
