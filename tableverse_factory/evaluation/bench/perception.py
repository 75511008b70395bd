"""Scores of perception against ground truth: masks and containment, capture by capture."""

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int32
from scipy.optimize import linear_sum_assignment

from schemas.config import Config, ObserveConfig
from schemas.geometry import Camera, DepthImage, Frozen, IdImage
from schemas.manifest import SceneKind
from schemas.objects import PerceivedObjects
from schemas.outcome import Done
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.bench.captures import find_file, list_captures, make_row, make_scene_id
from tableverse_factory.models.services import Services
from tableverse_factory.sources.capture import COLOR_NAMES, MASKS_NAME, read_id_image
from tableverse_factory.sources.discovery import GROUND_TRUTH_NAME
from tableverse_factory.stages.observe.observe import observe
from tableverse_factory.stages.perceive.perceive import perceive

TRUTH_NAMES = ("seg.png", MASKS_NAME)
GOOD_IOU = 0.5
TABLE_SHARE = 0.5
UNLABELLED = -2  # in a truth: nobody has said what this pixel shows
MOST_LABELLED = 1e-3  # share of the pixels without a reading that a truth drawn on the depth labels along outlines


@dataclass(frozen=True, slots=True)
class Containment:
    """Counts of containment pairs, an object and its container."""

    true: int  # true pairs with both objects visible in the true masks
    found: int
    correct: int  # found pairs whose objects match those of a true pair, one to one by their masks

    @property
    def precision(self) -> float:
        """Share of the pairs found that are true."""
        return self.correct / self.found if self.found else float("nan")

    @property
    def recall(self) -> float:
        """Share of the true pairs that were found."""
        return self.correct / self.true if self.true else float("nan")


@dataclass(frozen=True, slots=True)
class MaskScore:
    """Score of one capture, or of several."""

    name: str  # of the capture's folder
    truth: int  # true objects
    found: int  # objects found, those without a true object included
    ious: tuple[float, ...]  # best IoU of each true object with an object found
    overlap: int  # pixels that found and true objects share in the best one-to-one assignment
    found_pixels: int  # of all objects found that overlap a true object
    true_pixels: int  # of all true objects
    cpu_s: float  # CPU time of `perceive` [s]
    reason: str = ""  # why the scene was dropped, or the capture could not be read, or empty
    containment: Containment | None = None  # None without `truth.json`
    unread: bool = False

    @property
    def mean_iou(self) -> float:
        """Mean over the true objects of their best IoU."""
        return float(np.mean(self.ious)) if self.ious else float("nan")

    @property
    def recall(self) -> float:
        """Share of the true objects whose best IoU is at least one half."""
        return float(np.mean(np.array(self.ious) >= GOOD_IOU)) if self.ious else float("nan")

    @property
    def overlap_f(self) -> float:
        """Harmonic mean of overlap precision and recall, as in UOIS; objects found beside all true ones are free."""
        both = self.found_pixels + self.true_pixels
        return 2 * self.overlap / both if both else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class TrueMasks(Frozen):
    """True masks of a capture: `UNLABELLED` where nobody has said what a pixel shows, and what may be the table."""

    ids: IdImage
    largest_may_be_table: bool

    def remove_table(self, found: IdImage) -> IdImage:
        """Return the ids without the table, if it may be among them, see the function of this name."""
        return remove_table(self.ids, found) if self.largest_may_be_table else self.ids


def bench_masks(folder: Path, config: Config) -> Iterator[MaskScore]:
    """Score every capture in `folder` that has a truth, or `folder` itself, by name; what cannot be read says so.

    The truth is `seg.png` or `masks.png`, and `truth.json` for containment. The largest id of a `seg.png` may be the
    table: it is left out if most of it lies on the plane that was found.
    """
    captures = list_captures(folder, TRUTH_NAMES, COLOR_NAMES)
    if not captures:
        raise InputError(f"{str(folder)!r} holds no capture with {' or '.join(TRUTH_NAMES)}")
    for capture in captures:
        try:
            yield score_capture(capture, config)
        except InputError as error:
            yield MaskScore(capture.name, 0, 0, (), 0, 0, 0, 0.0, str(error), unread=True)


def score_capture(capture: Path, config: Config) -> MaskScore:
    """Run `observe` and `perceive` on one capture and compare the masks with the truth."""
    scene_id = make_scene_id(capture)
    services = Services(Path())
    seen = observe(
        make_row(SceneKind.CAPTURE, capture, scene_id),
        config,
        make_rng(config.run.seed, scene_id, "observe"),
        services,
    )
    if not isinstance(seen, Done):
        raise InputError(f"{capture.name}: {seen}")
    truth = read_true_masks(capture, config.observe, seen.value.camera, seen.value.depth)
    if truth is None:
        raise InputError(f"{capture.name} has no {' or '.join(TRUTH_NAMES)}")
    start = time.process_time()
    outcome = perceive(seen.value, config, make_rng(config.run.seed, scene_id, "perceive"), services)
    seconds = time.process_time() - start
    if isinstance(outcome, Done):
        found, pairs_found, reason = outcome.value.instance_ids, find_pairs(outcome.value), ""
        kept = truth.remove_table(found)
    else:
        found, pairs_found, reason = np.zeros_like(truth.ids), {}, getattr(outcome, "reason", str(outcome))
        kept = truth.remove_table(found - 1)
    found = remove_unlabelled(kept, found)
    score = compare_masks(capture.name, kept, found, seconds, reason)
    pairs = read_true_pairs(capture)
    return score if pairs is None else replace(score, containment=compare_pairs(kept, found, pairs, pairs_found))


def find_pairs(found: PerceivedObjects) -> dict[int, int]:
    """Map the instance id of each contained object to that of its container."""
    number = {item.object_id: item.instance_id for item in found.objects}
    return {item.instance_id: number[item.contained_in] for item in found.objects if item.contained_in is not None}


def read_true_pairs(capture: Path) -> dict[int, int] | None:
    """Read the true containment, from instance id to the container's; None without `truth.json`."""
    path = capture / GROUND_TRUTH_NAME
    if not path.is_file():
        return None
    try:
        entries = json.loads(path.read_text())["objects"]
        return {int(e["instance_id"]): int(e["contained_in"]) for e in entries if e["contained_in"] is not None}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{str(path)!r} does not say what lies in what: {error!r}") from error


def compare_pairs(truth: IdImage, found: IdImage, true: dict[int, int], pairs_found: dict[int, int]) -> Containment:
    """Count visible true pairs, found pairs and correct ones, by the ids of the two images."""
    seen = set(np.unique(truth).tolist())
    visible = {(inner, holder) for inner, holder in true.items() if inner in seen and holder in seen}
    meant = match_ids(truth, found)
    right = sum((meant.get(inner), meant.get(holder)) in visible for inner, holder in pairs_found.items())
    return Containment(len(visible), len(pairs_found), right)


def match_ids(truth: IdImage, found: IdImage) -> dict[int, int]:
    """Map found ids to true ids by the one-to-one assignment of the overlap F."""
    true_ids, found_ids = _list_ids(truth), _list_ids(found)
    shared, true_sizes, found_sizes = _count_overlaps(truth, found)
    rows, columns = _assign_by_f(shared, true_sizes, found_sizes)
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {int(found_ids[f]): int(true_ids[t]) for t, f in pairs if shared[t, f] > 0}


def read_true_masks(capture: Path, bounds: ObserveConfig, camera: Camera, depth: DepthImage) -> TrueMasks | None:
    """Read the true masks of a capture, whose `seg.png` may number the table; None if it has none."""
    path = find_file(capture, TRUTH_NAMES)
    if path is None:
        return None
    return TrueMasks(mark_unlabelled(read_id_image(str(path), bounds, camera), depth), path.name == TRUTH_NAMES[0])


def remove_table(truth: IdImage, found: IdImage) -> IdImage:
    """Set the largest id of the truth to background if most of its pixels were found to be table (-1)."""
    sizes = np.bincount(truth[truth > 0])
    if len(sizes) == 0:
        return truth
    largest = int(np.argmax(sizes))
    share = float((found[truth == largest] == -1).mean())
    return np.where(truth == largest, 0, truth).astype(np.int32) if share >= TABLE_SHARE else truth


def mark_unlabelled(truth: IdImage, depth: DepthImage) -> IdImage:
    """Mark the pixels without a reading in `depth` as `UNLABELLED` in a truth that labels next to nothing there.

    Such a truth was drawn on the depth: the sides of boxes beyond a sensor's range would else count as background.
    """
    unread = depth <= 0
    labels = int((truth[unread] > 0).sum())
    if labels > MOST_LABELLED * int(unread.sum()):
        return truth
    return np.where(unread, UNLABELLED, truth).astype(np.int32)


def remove_unlabelled(truth: IdImage, found: IdImage) -> IdImage:
    """Set what was found to background where the truth is `UNLABELLED`."""
    return np.where(truth == UNLABELLED, 0, found).astype(np.int32)


def compare_masks(name: str, truth: IdImage, found: IdImage, cpu_s: float, reason: str = "") -> MaskScore:
    """Compare two id images of the same shape; ids above 0 are objects."""
    shared, true_sizes, found_sizes = _count_overlaps(truth, found)
    union = true_sizes[:, None] + found_sizes[None] - shared
    ious = (shared / np.maximum(union, 1)).max(axis=1, initial=0.0)
    rows, columns = _assign_by_f(shared, true_sizes, found_sizes)
    known = found_sizes[shared.any(axis=0)] if len(found_sizes) else found_sizes
    return MaskScore(
        name,
        len(true_sizes),
        len(found_sizes),
        tuple(float(v) for v in ious),
        int(shared[rows, columns].sum()),
        int(known.sum()),
        int(true_sizes.sum()),
        cpu_s,
        reason,
    )


def merge_scores(scores: list[MaskScore]) -> MaskScore:
    """Merge the scores of captures; means are over all true objects."""
    total, scores = len(scores), [score for score in scores if not score.unread]
    known = [(c.true, c.found, c.correct) for c in (score.containment for score in scores) if c is not None]
    return MaskScore(
        "all",
        sum(s.truth for s in scores),
        sum(s.found for s in scores),
        tuple(v for s in scores for v in s.ious),
        sum(s.overlap for s in scores),
        sum(s.found_pixels for s in scores),
        sum(s.true_pixels for s in scores),
        float(np.median([s.cpu_s for s in scores])) if scores else 0.0,
        f"without {total - len(scores)} of {total} captures" if len(scores) < total else "",
        containment=Containment(*(sum(counts) for counts in zip(*known, strict=True))) if known else None,
    )


def _list_ids(image: IdImage) -> Int32[np.ndarray, " n"]:
    return np.unique(image[image > 0])


def _count_overlaps(
    truth: IdImage, found: IdImage
) -> tuple[Float64[np.ndarray, "t f"], Float64[np.ndarray, " t"], Float64[np.ndarray, " f"]]:
    true_ids, found_ids = _list_ids(truth), _list_ids(found)
    shared = np.array([[((truth == t) & (found == f)).sum() for f in found_ids] for t in true_ids], dtype=np.float64)
    true_sizes = np.array([(truth == t).sum() for t in true_ids], dtype=np.float64)
    found_sizes = np.array([(found == f).sum() for f in found_ids], dtype=np.float64)
    return shared.reshape(len(true_ids), len(found_ids)), true_sizes, found_sizes


def _assign_by_f(
    shared: Float64[np.ndarray, "t f"], true_sizes: Float64[np.ndarray, " t"], found_sizes: Float64[np.ndarray, " f"]
) -> tuple[np.ndarray, np.ndarray]:
    """Assign true (rows) to found objects (columns), one to one, by the largest sum of their pairwise F."""
    return linear_sum_assignment(-2 * shared / np.maximum(true_sizes[:, None] + found_sizes[None], 1))
