"""Scores of bare pictures: the colour of captures through `observe` and `perceive`, against their depth and masks."""

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float64

from schemas.config import Config, ObserveConfig, PerceiveConfig
from schemas.geometry import DepthImage
from schemas.known_length import KnownDistance, KnownLength, KnownSheet, encode_known_length
from schemas.manifest import SceneKind
from schemas.objects import PerceivedObjects
from schemas.observation import Observation
from schemas.outcome import Done, Outcome
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.bench.captures import list_captures, make_row
from tableverse_factory.evaluation.bench.marked_sheet import mark_sheet
from tableverse_factory.evaluation.bench.perception import (
    MaskScore,
    compare_masks,
    merge_scores,
    read_true_masks,
    remove_unlabelled,
)
from tableverse_factory.evaluation.bench.picture_shapes import ShapeScore, compare_proportions
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.models.services import Services
from tableverse_factory.sources.capture import CAMERA_NAME, COLOR_NAMES
from tableverse_factory.sources.image_file import read_image
from tableverse_factory.stages.observe.observe import observe
from tableverse_factory.stages.perceive.perceive import perceive
from tableverse_factory.stages.perceive.scale.surface import measure_distance

MIN_PIXELS = 100  # of table and objects, for a scale


@dataclass(frozen=True, slots=True)
class PictureScore:
    """Score of one bare picture; figures are NaN where it was dropped, or nothing tells the truth."""

    name: str
    depth_error: float  # mean relative error of the depth of table and objects, one scale taken out
    log_scale: float  # logarithm of that scale: true over predicted depth
    scale_sigma: float  # standard deviation that was stated for it
    measured_error: float  # mean relative error of the same depth, after one length was measured in the picture
    plane_deg: float  # angle between the table's normals [°]
    cpu_s: float  # CPU time of `observe` and `perceive` [s]
    masks: MaskScore | None = None  # None without true masks
    reason: str = ""  # why the picture was dropped, or the capture could not be read, or empty
    unread: bool = False
    shapes: ShapeScore | None = None  # None unless it was asked for, or for a dropped picture

    @property
    def is_within_sigma(self) -> bool:
        """Whether the scale is within one stated standard deviation."""
        return abs(self.log_scale) <= self.scale_sigma


@dataclass(frozen=True, slots=True)
class PictureSummary:
    """Figures of several bare pictures, over those that were not dropped."""

    pictures: int
    dropped: int
    unread: int  # captures that could not be read
    depth_error: float  # mean
    measured_error: float  # median
    plane_deg: float  # median [°]
    scale_error: float  # median of the scale's relative error
    within_sigma: float  # share of pictures whose scale is within the stated standard deviation
    cpu_s: float  # median [s]
    masks: MaskScore | None
    proportion_error: float  # median over the things of all pictures, alike for too flat and too high


def bench_pictures(
    folder: Path,
    config: Config,
    with_focal: bool = False,
    on_picture: Callable[[int, int], object] = lambda _done, _total: None,
    *,
    with_shapes: bool = False,
    with_sheet: bool = False,
) -> Iterator[PictureScore]:
    """Score the colour of every capture in `folder`, or of `folder` itself, by name; what cannot be read says so.

    What lies on the table, and where the table is, tells the sensor through the detector `geometric`; objects are those
    of `seg.png` or `masks.png` where there is one. `with_focal` gives the net the capture's focal length. `with_shapes`
    compares the proportions of the shapes too. `with_sheet` measures by a sheet of A4, marked on the table where one
    would lie free, instead of a distance.
    """
    captures = list_captures(folder, [CAMERA_NAME])
    if not captures:
        raise InputError(f"{str(folder)!r} holds no capture: a folder with color.png, depth.png and camera.json")
    for done, capture in enumerate(captures, 1):
        try:
            yield score_picture(capture, config, with_focal, with_shapes=with_shapes, with_sheet=with_sheet)
        except InputError as error:
            nothing = float("nan")
            figures = (nothing,) * 5
            yield PictureScore(capture.name, *figures, 0.0, None, str(error), unread=True)
        on_picture(done, len(captures))


def bench_other_pictures(folder: Path, config: Config) -> Iterator[tuple[str, str]]:
    """Give the name of every picture in `folder`, which show no table-top, and why it was dropped, or nothing."""
    names = sorted(path.name for path in folder.iterdir() if path.is_file())
    if not names:
        raise InputError(f"{str(folder)!r} holds no picture")
    for name in names:
        read_image(str(folder / name), config.observe)  # a file that is no picture is none that was dropped rightly
        yield name, getattr(_perceive_picture(folder / name, config), "reason", "")


def score_picture(
    capture: Path, config: Config, with_focal: bool = False, *, with_shapes: bool = False, with_sheet: bool = False
) -> PictureScore:
    """Run `observe` and `perceive` on the colour of a capture and compare with its depth and masks.

    `with_shapes` runs `place` on both too, and compares the shapes; the CPU time does not count it.
    """
    sensor, truth = _perceive_truth(capture, config)
    if with_focal:
        focal = config.observe.model_copy(update={"focal_px": sensor.camera.fx})
        config = config.model_copy(update={"observe": focal})
    color = next(capture / name for name in COLOR_NAMES if (capture / name).is_file())
    start = time.process_time()
    outcome = _perceive_picture(color, config)
    cpu_s = time.process_time() - start
    by_depth = np.zeros(sensor.depth.shape, dtype=np.int32) if truth is None else truth.instance_ids
    true_masks = read_true_masks(capture, config.observe, sensor.camera, sensor.depth)
    ids = np.maximum(by_depth, 0) if true_masks is None else true_masks.remove_table(by_depth)
    found = outcome.value if isinstance(outcome, Done) else None
    reason = "" if found else str(getattr(outcome, "reason", outcome))
    masks = None
    if true_masks is not None:
        own = resize_nearest(found.instance_ids, ids.shape) if found else np.zeros_like(ids)
        masks = compare_masks(capture.name, ids, remove_unlabelled(ids, own), cpu_s, reason)
    nothing = float("nan")
    if found is None or truth is None:
        return PictureScore(capture.name, nothing, nothing, nothing, nothing, nothing, cpu_s, masks, reason)
    wanted = (ids > 0) | (truth.instance_ids == -1)
    depth = resize_nearest(found.observation.depth, sensor.depth.shape)
    error, log_scale = compare_depth(depth, sensor.depth, wanted)
    if with_sheet:
        measured = _compare_with_sheet(
            color, config, mark_sheet(truth, make_rng(config.run.seed, capture.name, "sheet")), sensor, wanted
        )
    else:
        measured = compare_measured_depth(found.observation, sensor, wanted)
    plane = measure_angle_deg(get_table_normal(found), get_table_normal(truth))
    sigma = found.observation.scale_sigma
    found_ids = resize_nearest(found.instance_ids, truth.instance_ids.shape)
    shapes = compare_proportions(found, found_ids, truth, config) if with_shapes else None
    return PictureScore(capture.name, error, log_scale, sigma, measured, plane, cpu_s, masks, shapes=shapes)


def compare_depth(depth: DepthImage, true: DepthImage, wanted: np.ndarray) -> tuple[float, float]:
    """Compare depth where it is `wanted` and both are known, after one scale, the median ratio.

    Returns the mean relative error, and the logarithm of the scale; both NaN for fewer than `MIN_PIXELS`.
    """
    both = wanted & (depth > 0) & (true > 0)
    if int(both.sum()) < MIN_PIXELS:
        return float("nan"), float("nan")
    ratio = true[both] / depth[both].astype(np.float64)
    scale = float(np.median(ratio))
    return float(np.mean(np.abs(scale / ratio - 1.0))), float(np.log(scale))


def compare_measured_depth(found: Observation, sensor: Observation, wanted: np.ndarray) -> float:
    """Compare depth where it is `wanted` and both are known, after the scale of one distance that the sensor measures.

    The distance is that between the pixels of the first and the last twentieth column, as a tape would span the table.
    Returns the mean relative error; NaN for fewer than `MIN_PIXELS`, or where the distance cannot be measured.
    """
    depth = resize_nearest(found.depth, sensor.depth.shape)
    both = wanted & (depth > 0) & (sensor.depth > 0)
    if int(both.sum()) < MIN_PIXELS:
        return float("nan")
    rows, columns = np.nonzero(both)
    order = np.argsort(columns, kind="stable")
    outer = order[[len(order) // 20, -len(order) // 20]]
    ends = np.stack([columns[outer], rows[outer]], axis=1) / sensor.depth.shape[::-1]
    try:
        true, own = (_measure_between(ends, seen) for seen in (sensor, found))
    except InputError:  # an end lies where depth is torn: a person would mark another
        return float("nan")
    return float(np.mean(np.abs(true / own * depth[both].astype(np.float64) / sensor.depth[both] - 1.0)))


def _compare_with_sheet(
    path: Path, config: Config, known: KnownSheet | None, sensor: Observation, wanted: np.ndarray
) -> float:
    """Compare depth where it is `wanted`, in the metres that a sheet gives it; NaN without a sheet or a scene."""
    outcome = None if known is None else _perceive_picture(path, config, known)
    if not isinstance(outcome, Done):
        return float("nan")
    depth = resize_nearest(outcome.value.observation.depth, sensor.depth.shape)
    both = wanted & (depth > 0) & (sensor.depth > 0)
    return float(np.mean(np.abs(depth[both].astype(np.float64) / sensor.depth[both] - 1.0))) if both.any() else math.nan


def _measure_between(ends: np.ndarray, seen: Observation) -> float:
    """Measure the distance between two points of a picture, given in shares of its sides, shape (2, 2)."""
    (a, b), (c, d) = (ends * seen.depth.shape[::-1]).tolist()
    return measure_distance(seen, KnownDistance(kind="distance", length_m=1.0, pixels=((a, b), (c, d)))).length_m


def get_table_normal(found: PerceivedObjects) -> Float64[np.ndarray, "3"]:
    """Get the table's normal in the camera frame."""
    normal: Float64[np.ndarray, "3"] = rotation_matrix(found.camera_to_table.quaternion_wxyz)[2]
    return normal


def measure_angle_deg(a: Float64[np.ndarray, "3"], b: Float64[np.ndarray, "3"]) -> float:
    """Measure the angle between two unit vectors [°]."""
    return float(np.degrees(np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)))


def summarize_pictures(scores: Sequence[PictureScore]) -> PictureSummary:
    """Summarise scores; masks are over all true objects, those of dropped pictures too."""
    known = [score for score in scores if np.isfinite(score.depth_error)]
    masks = [score.masks for score in scores if score.masks is not None]
    return PictureSummary(
        len(scores),
        sum(bool(score.reason) and not score.unread for score in scores),
        sum(score.unread for score in scores),
        _average(score.depth_error for score in known),
        _find_median(score.measured_error for score in known if np.isfinite(score.measured_error)),
        _find_median(score.plane_deg for score in known),
        _find_median(abs(float(np.expm1(-score.log_scale))) for score in known),
        _average(score.is_within_sigma for score in known),
        _find_median(score.cpu_s for score in scores if not score.unread),
        merge_scores(masks) if masks else None,
        _find_median(
            float(np.expm1(abs(thing.log_ratio)))
            for score in scores
            if score.shapes is not None
            for thing in score.shapes.proportions
        ),
    )


def resize_nearest(image: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Resize an image of ids or depths to (h, w) by the nearest pixels."""
    rows, columns = ((np.arange(n) + 0.5) * (own / n) for n, own in zip(shape, image.shape, strict=True))
    return image[np.ix_(rows.astype(np.intp), columns.astype(np.intp))]


def _perceive_truth(capture: Path, config: Config) -> tuple[Observation, PerceivedObjects | None]:
    """Read the capture with its sensor's depth, and find its table and objects by that; None without a table."""
    own = Config(run=config.run, observe=ObserveConfig(), perceive=PerceiveConfig(detector="geometric"))
    seen = _observe(SceneKind.CAPTURE, capture, own)
    if not isinstance(seen, Done):
        raise InputError(f"{capture.name}: {seen}")
    outcome = perceive(seen.value, own, _seed(own), Services(Path()))
    return seen.value, outcome.value if isinstance(outcome, Done) else None


def _observe(kind: SceneKind, path: Path, config: Config, known: KnownLength | None = None) -> Outcome[Observation]:
    row = make_row(kind, path, "picture", encode_known_length(known))
    return observe(row, config, _seed(config), Services(Path()))


def _perceive_picture(path: Path, config: Config, known: KnownLength | None = None) -> Outcome[PerceivedObjects]:
    seen = _observe(SceneKind.IMAGE, path, config, known)
    return perceive(seen.value, config, _seed(config), Services(Path())) if isinstance(seen, Done) else seen


def _seed(config: Config) -> np.random.Generator:
    return make_rng(config.run.seed, "picture", "perceive")


def _average(values: Iterable[float]) -> float:
    known = list(values)
    return float(np.mean(known)) if known else float("nan")


def _find_median(values: Iterable[float]) -> float:
    known = list(values)
    return float(np.median(known)) if known else float("nan")
