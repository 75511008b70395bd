"""How well objects are found: masks and what lies in what against ground truth, capture by capture."""

import json
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from scipy.optimize import linear_sum_assignment

from schemas.config import Config
from schemas.geometry import IdImage
from schemas.identity import check_id
from schemas.manifest import ImageRow, SceneKind
from schemas.objects import PerceivedObjects
from schemas.observation import Observation
from schemas.outcome import Done
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.seeding import rng_for
from tableverse_factory.models.services import Services
from tableverse_factory.sources.capture import COLOR_NAMES, MASKS_NAME, read_id_image
from tableverse_factory.sources.discovery import TRUTH_NAME
from tableverse_factory.stages.observe.observe import observe
from tableverse_factory.stages.perceive.perceive import perceive

TRUTH_NAMES = ("seg.png", MASKS_NAME)
GOOD_IOU = 0.5
TABLE_SHARE = 0.5


@dataclass(frozen=True, slots=True)
class Containment:
    """What lies in what, counted in pairs of a thing and what holds it.

    Attributes:
        true: Pairs of which the true masks show both.
        said: Pairs that were found.
        right: Found pairs whose two things are those of a true pair, matched one to one by their masks.
    """

    true: int
    said: int
    right: int

    @property
    def precision(self) -> float:
        """Share of the pairs found that are true."""
        return self.right / self.said if self.said else float("nan")

    @property
    def recall(self) -> float:
        """Share of the true pairs that were found."""
        return self.right / self.true if self.true else float("nan")


@dataclass(frozen=True, slots=True)
class MaskScore:
    """One capture, or several together.

    Attributes:
        name: Of the capture's folder.
        truth: Number of true objects.
        found: Number of objects found, also those that the truth does not know.
        ious: Of each true object with the object found that fits it best.
        overlap: Pixels that the best one-to-one assignment of found to true objects has in common.
        found_pixels: Pixels of all objects found, where the truth names what is there.
        true_pixels: Pixels of all true objects.
        cpu_s: Of `perceive` [s].
        reason: Why nothing was found, or empty.
        containment: What lies in what; None where no `truth.json` knows it.
    """

    name: str
    truth: int
    found: int
    ious: tuple[float, ...]
    overlap: int
    found_pixels: int
    true_pixels: int
    cpu_s: float
    reason: str = ""
    containment: Containment | None = None

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
        """Harmonic mean of overlap precision and recall, as UOIS counts them."""
        both = self.found_pixels + self.true_pixels
        return 2 * self.overlap / both if both else float("nan")


def bench_masks(folder: Path, config: Config) -> Iterator[MaskScore]:
    """Scores every capture in `folder` that has a truth, in the order of their names.

    The truth is `seg.png` or `masks.png`, and `truth.json` for what lies in what. In a `seg.png` the largest id may be
    the table: it is left out where most of it lies on the plane found.

    Raises:
        InputError: if the folder holds no such capture.
    """
    names = sorted(p.name for p in folder.iterdir() if _truth_path(p) is not None and _has_picture(p))
    if not names:
        raise InputError(f"{str(folder)!r} holds no capture with {' or '.join(TRUTH_NAMES)}")
    for name in names:
        yield score_capture(folder / name, config)


def score_capture(capture: Path, config: Config) -> MaskScore:
    """Runs `observe` and `perceive` on one capture and compares the masks.

    Raises:
        InputError: if the capture cannot be read.
    """
    scene_id = check_id(capture.name)
    services = Services(Path())
    seen = observe(
        ImageRow(scene_id=scene_id, kind=SceneKind.CAPTURE, uri=str(capture)),
        config,
        rng_for(config.run.seed, scene_id, "observe"),
        services,
    )
    if not isinstance(seen, Done):
        raise InputError(f"{capture.name}: {seen}")
    truth = _read_truth(capture, seen.value, config)
    start = time.process_time()
    outcome = perceive(seen.value, config, rng_for(config.run.seed, scene_id, "perceive"), services)
    seconds = time.process_time() - start
    is_seg = (capture / TRUTH_NAMES[0]).is_file()
    if isinstance(outcome, Done):
        found, said, reason = outcome.value.instance_ids, said_pairs(outcome.value), ""
        kept = without_table(truth, found) if is_seg else truth
    else:
        found, said, reason = np.zeros_like(truth), {}, getattr(outcome, "reason", str(outcome))
        kept = without_table(truth, np.full_like(truth, -1)) if is_seg else truth
    score = compare_masks(capture.name, kept, found, seconds, reason)
    pairs = true_pairs(capture)
    return score if pairs is None else replace(score, containment=compare_pairs(kept, found, pairs, said))


def said_pairs(found: PerceivedObjects) -> dict[int, int]:
    """Instance ids of the things found to lie in another, and of what holds each."""
    number = {item.object_id: item.instance_id for item in found.objects}
    return {item.instance_id: number[item.contained_in] for item in found.objects if item.contained_in is not None}


def true_pairs(capture: Path) -> dict[int, int] | None:
    """Instance ids of what lies in another by the `truth.json`, and of what holds each; None where there is no such.

    Raises:
        InputError: if the file is not as `tableverse synth` writes it.
    """
    path = capture / TRUTH_NAME
    if not path.is_file():
        return None
    try:
        entries = json.loads(path.read_text())["objects"]
        return {int(e["instance_id"]): int(e["contained_in"]) for e in entries if e["contained_in"] is not None}
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{str(path)!r} does not say what lies in what: {error!r}") from error


def compare_pairs(truth: IdImage, found: IdImage, true: dict[int, int], said: dict[int, int]) -> Containment:
    """Counts the pairs of which both are seen, those said, and those said rightly, by ids of the two images."""
    seen = set(np.unique(truth).tolist())
    visible = {(inner, holder) for inner, holder in true.items() if inner in seen and holder in seen}
    meant = matched(truth, found)
    right = sum((meant.get(inner), meant.get(holder)) in visible for inner, holder in said.items())
    return Containment(len(visible), len(said), right)


def matched(truth: IdImage, found: IdImage) -> dict[int, int]:
    """For each id found the true one that it stands for: the best one-to-one assignment, as the overlap F has it."""
    true_ids, found_ids = np.unique(truth[truth > 0]), np.unique(found[found > 0])
    shared, true_sizes, found_sizes = _overlaps(truth, found, true_ids, found_ids)
    rows, columns = linear_sum_assignment(-_pairwise_f(shared, true_sizes, found_sizes))
    pairs = zip(rows.tolist(), columns.tolist(), strict=True)
    return {int(found_ids[f]): int(true_ids[t]) for t, f in pairs if shared[t, f] > 0}


def without_table(truth: IdImage, found: IdImage) -> IdImage:
    """The truth with its largest id taken for background, if most of it was found to be table (-1)."""
    sizes = np.bincount(truth[truth > 0])
    if len(sizes) == 0:
        return truth
    largest = int(np.argmax(sizes))
    share = float((found[truth == largest] == -1).mean())
    return np.where(truth == largest, 0, truth).astype(np.int32) if share >= TABLE_SHARE else truth


def compare_masks(name: str, truth: IdImage, found: IdImage, cpu_s: float, reason: str = "") -> MaskScore:
    """Counts what two id images of the same shape have in common; ids above 0 are objects."""
    true_ids, found_ids = np.unique(truth[truth > 0]), np.unique(found[found > 0])
    shared, true_sizes, found_sizes = _overlaps(truth, found, true_ids, found_ids)
    union = true_sizes[:, None] + found_sizes[None] - shared
    ious = (shared / np.maximum(union, 1)).max(axis=1, initial=0.0)
    rows, columns = linear_sum_assignment(-_pairwise_f(shared, true_sizes, found_sizes))
    known = found_sizes[shared.any(axis=0)] if len(found_ids) else found_sizes
    return MaskScore(
        name,
        len(true_ids),
        len(found_ids),
        tuple(float(v) for v in ious),
        int(shared[rows, columns].sum()),
        int(known.sum()),
        int(true_sizes.sum()),
        cpu_s,
        reason,
    )


def together(scores: list[MaskScore]) -> MaskScore:
    """All captures as one: the means are over all true objects."""
    return MaskScore(
        "all",
        sum(s.truth for s in scores),
        sum(s.found for s in scores),
        tuple(v for s in scores for v in s.ious),
        sum(s.overlap for s in scores),
        sum(s.found_pixels for s in scores),
        sum(s.true_pixels for s in scores),
        float(np.median([s.cpu_s for s in scores])),
        containment=_pairs_together([s.containment for s in scores if s.containment is not None]),
    )


def _pairs_together(known: list[Containment]) -> Containment | None:
    if not known:
        return None
    return Containment(sum(c.true for c in known), sum(c.said for c in known), sum(c.right for c in known))


def _overlaps(
    truth: IdImage, found: IdImage, true_ids: IdImage, found_ids: IdImage
) -> tuple[Float64[np.ndarray, "t f"], Float64[np.ndarray, " t"], Float64[np.ndarray, " f"]]:
    shared = np.array([[((truth == t) & (found == f)).sum() for f in found_ids] for t in true_ids], dtype=np.float64)
    true_sizes = np.array([(truth == t).sum() for t in true_ids], dtype=np.float64)
    found_sizes = np.array([(found == f).sum() for f in found_ids], dtype=np.float64)
    return shared.reshape(len(true_ids), len(found_ids)), true_sizes, found_sizes


def _pairwise_f(
    shared: Float64[np.ndarray, "t f"], true_sizes: Float64[np.ndarray, " t"], found_sizes: Float64[np.ndarray, " f"]
) -> Float64[np.ndarray, "t f"]:
    f: Float64[np.ndarray, "t f"] = 2 * shared / np.maximum(true_sizes[:, None] + found_sizes[None], 1)
    return f


def _truth_path(capture: Path) -> Path | None:
    return next((capture / name for name in TRUTH_NAMES if (capture / name).is_file()), None)


def _has_picture(capture: Path) -> bool:
    return any((capture / name).is_file() for name in COLOR_NAMES)


def _read_truth(capture: Path, seen: Observation, config: Config) -> IdImage:
    path = _truth_path(capture)
    if path is None:
        raise InputError(f"{capture.name} has no {' or '.join(TRUTH_NAMES)}")
    return read_id_image(str(path), config.observe, seen.camera)
