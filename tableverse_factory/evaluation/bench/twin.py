"""Comparison of exported scenes with the photographs that they were made from, from the cameras of these."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
from skimage.color import deltaE_ciede2000, rgb2lab

from schemas.config import Config
from schemas.geometry import Frozen, IdImage, Mask, Picture
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done
from tableverse_factory.core.cache_dir import get_cache_dir
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.core.storage.untrusted import parse_json
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.evaluation.bench.perception import match_ids, read_true_masks, remove_unlabelled
from tableverse_factory.evaluation.bench.twin_relations import compare_twin_relations
from tableverse_factory.evaluation.bench.twin_views import TwinView, decode_masks, render_twin, write_side_by_side
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.relations.preserved import PreservedRelations
from tableverse_factory.models.services import Services
from tableverse_factory.physics.render.silhouettes import compare_silhouettes
from tableverse_factory.pipeline import PIPELINES
from tableverse_factory.sources.capture import Capture, read_capture
from tableverse_factory.sources.manifest import make_manifest

TABLE_NOISE_M = 0.01  # a reading this near the table plane is of the table
NOT_BUILT = "not in the dataset"
NO_RELATIONS = PreservedRelations()


@dataclass(frozen=True, slots=True)
class TwinThing:
    """One thing of a photograph, and how its twin shows it."""

    twin: str = ""  # its object in the scene; empty for a lost thing, of which the errors are NaN
    silhouette_iou: float = 0.0
    depth_error_m: float = float("nan")  # median distance along the axis from the sensor's readings [m]
    color_difference: float = float("nan")  # median CIEDE2000


@dataclass(frozen=True, slots=True)
class TwinScore:
    """Score of the twin of one capture."""

    name: str  # of the capture's folder
    things: tuple[TwinThing, ...]
    extra: int = 0  # objects of the scene that are no thing of the photograph
    relations: PreservedRelations = NO_RELATIONS  # those of the photograph, and those that hold in the scene
    truth: bool = False  # whether the things are ground truth; else what perception found
    reason: str = ""  # why there is no scene, or empty
    explained_area: float | None = None  # share of what stands above the table, as the scene states it

    @property
    def number(self) -> float:
        """Mean silhouette IoU of the things, 0 for each that is lost; NaN if no thing is known."""
        return float(np.mean([thing.silhouette_iou for thing in self.things])) if self.things else float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class TwinPair(Frozen):
    """A photograph and its twin, as pictures show them; `things` and `shown` have the same ids for the same thing."""

    photograph: Picture
    twin: Picture
    things: IdImage
    shown: IdImage


def find_captures(folder: Path, config: Config, dataset: str = "") -> list[ImageRow]:
    """List the captures of a folder, sorted by name; those that cannot be read are rejected rows.

    Raises:
        InputError: `no_scenes`, if there are none that can be read, or none is in the dataset that is given.
    """
    rows = make_manifest([str(folder)], config.observe).rows
    captures = sorted((row for row in rows if row.kind is SceneKind.CAPTURE), key=lambda row: row.name)
    if not captures:
        raise InputError(f"{folder}: no captures; each is a folder with color.png, depth.png, camera.json", "no_scenes")
    if all(row.rejected for row in captures):
        first = f"{captures[0].name}: {captures[0].rejected}: {captures[0].rejected_detail}"
        raise InputError(f"{folder}: none of {len(captures)} captures can be read; the first: {first}", "no_scenes")
    if dataset:
        known = set(open_dataset(dataset).scenes.to_table(columns=["scene_id"])["scene_id"].to_pylist())
        if known.isdisjoint(row.scene_id for row in captures):
            raise InputError(f"{dataset}: no scene of a capture in {folder}", "no_scenes")
    return captures


def measure_twin(row: ImageRow, config: Config, dataset: str, pictures: Path | None) -> TwinScore:
    """Score one capture, of a dataset or computed (`dataset` empty); write `NAME.jpg` into the folder `pictures`.

    One that cannot be read has no things, and the reason.
    """
    if row.rejected:
        return TwinScore(row.name, (), reason=f"{row.rejected}: {row.rejected_detail}")
    try:
        score, pair = compare_twin(row, config, open_dataset(dataset) if dataset else None)
    except InputError as error:
        return TwinScore(row.name, (), reason=str(error))
    if pictures is not None:
        file = pictures / f"{row.name}.jpg"
        write_side_by_side(file, pair.photograph, pair.twin, pair.things, pair.shown)
    return score


def compare_twin(row: ImageRow, config: Config, built: Dataset | None) -> tuple[TwinScore, TwinPair]:
    """Compare the scene of a capture with its photograph; it is computed where no dataset is given."""
    capture = read_capture(row.uri, config.observe)
    files, reason = _build_files(row, config) if built is None else _read_files(row, built)
    if files is None:
        return _score_lost(row, capture, config, reason)
    return compare_files(row, capture, files, config)


def compare_files(
    row: ImageRow, capture: Capture, files: Mapping[str, bytes], config: Config
) -> tuple[TwinScore, TwinPair]:
    """Compare the files of an exported scene with its photograph."""
    meta = parse_json(files["meta.json"], f"{row.name}: meta.json", "bad_meta")
    view = render_twin(files, meta, row.name)
    masks = decode_masks(files, view.eye.camera, config.observe)
    truth = read_true_masks(Path(row.uri), config.observe, capture.camera, capture.depth)
    if truth is None:
        # Where the sensor measured nothing, perception can give no pixel to a thing.
        things, shown = masks, np.where((masks == 0) & (capture.depth == 0), 0, view.ids)
    else:
        things = truth.remove_table(np.where(_find_table_pixels(capture, view), -1, masks))
        shown = _match_things(things, remove_unlabelled(things, view.ids), view)
    compared = tuple(_compare_things(capture, view, things, shown))
    score = TwinScore(
        row.name,
        compared,
        len(view.names) - sum(bool(thing.twin) for thing in compared),
        compare_twin_relations(Path(row.uri), capture, files, meta, masks),
        truth is not None,
        explained_area=meta.get("fidelity", {}).get("explained_area"),
    )
    return score, TwinPair(capture.color, view.color, things, shown)


def summarize_twins(scores: Sequence[TwinScore]) -> dict[str, float]:
    """Summarize captures: over all things, of those with a twin where there is something to measure."""
    things = [thing for score in scores for thing in score.things]
    relations = sum((score.relations for score in scores), NO_RELATIONS)
    of_all = [thing.silhouette_iou for thing in things]
    return {
        "captures": len(scores),
        "scenes": sum(not score.reason for score in scores),
        "things": len(things),
        "lost": sum(not thing.twin for thing in things),
        "extra": sum(score.extra for score in scores),
        "twin": float(np.mean(of_all)) if things else float("nan"),
        "silhouette_iou": float(np.median(of_all)) if things else float("nan"),
        "depth_error_m": _take_median([thing.depth_error_m for thing in things]),
        "explained_area": _take_median([its.explained_area for its in scores if its.explained_area is not None]),
        "color_difference": _take_median([thing.color_difference for thing in things]),
        "supports": relations.carried,
        "supports_kept": relations.carried_kept,
        "containments": relations.contained,
        "containments_kept": relations.contained_kept,
    }


def _take_median(values: Sequence[float] | np.ndarray) -> float:
    known = [value for value in values if np.isfinite(value)]
    return float(np.median(known)) if known else float("nan")


def _build_files(row: ImageRow, config: Config) -> tuple[Mapping[str, bytes] | None, str]:
    """Run the line on a capture: the files of its scene, or None and the reason why there are none."""
    value: Any = row
    for stage in PIPELINES[row.kind]:
        rng = make_rng(config.run.seed, row.scene_id, stage.name)
        outcome = stage.run(value, config, rng, Services(get_cache_dir()))
        if not isinstance(outcome, Done):
            return None, str(outcome)
        value = outcome.value
    return dict(value.files), ""


def _read_files(row: ImageRow, built: Dataset) -> tuple[Mapping[str, bytes] | None, str]:
    known = built.scenes.to_table(filter=pc.field("scene_id") == row.scene_id).to_pylist()
    if not known:
        return None, NOT_BUILT
    if known[0]["status"] != "done":
        return None, f"{known[0]['reason'] or known[0]['error_kind']}: {known[0]['detail']}"
    return built.scene(row.scene_id).files(), ""


def _score_lost(row: ImageRow, capture: Capture, config: Config, reason: str) -> tuple[TwinScore, TwinPair]:
    """Score a capture without a scene: each thing that is known is lost."""
    truth = read_true_masks(Path(row.uri), config.observe, capture.camera, capture.depth)
    nothing = np.zeros(capture.color.shape[:2], dtype=np.int32)
    things = nothing if truth is None else truth.remove_table(nothing - 1)
    lost = tuple(TwinThing() for _ in np.unique(things[things > 0]))
    blank = np.full_like(capture.color, 255)
    return TwinScore(row.name, lost, truth=truth is not None, reason=reason), TwinPair(
        capture.color, blank, things, nothing
    )


def _find_table_pixels(capture: Capture, view: TwinView) -> Mask:
    """Find the pixels whose readings lie on the table plane."""
    points = backproject(capture.depth, capture.camera).reshape(-1, 3)
    heights = transform_points(view.eye.camera_to_table, points)[:, 2].reshape(capture.depth.shape)
    return (capture.depth > 0) & (np.abs(heights) <= TABLE_NOISE_M)


def _match_things(truth: IdImage, ids: IdImage, view: TwinView) -> IdImage:
    """Give the twin's objects, `ids`, the ids of the true things that they match; the others get ids of their own."""
    matched = match_ids(truth, ids)
    above = int(max(truth.max(), view.ids.max(initial=0), *view.names, *matched.values(), 0)) + 1
    number = np.arange(above) + above
    number[0] = 0
    number[list(matched)] = list(matched.values())
    return number[ids].astype(np.int32)


def _compare_things(capture: Capture, view: TwinView, things: IdImage, shown: IdImage) -> Iterator[TwinThing]:
    """Compare each thing with the object that is shown with its id."""
    ious = compare_silhouettes(things, shown)
    for value in np.unique(things[things > 0]).tolist():
        both = (things == value) & (shown == value)
        if not both.any():
            yield TwinThing()
            continue
        name = view.names[int(view.ids[both][0])]
        measured = both & (capture.depth > 0)
        errors = np.abs(view.depth[measured] - capture.depth[measured])
        differences = deltaE_ciede2000(rgb2lab(capture.color[both]), rgb2lab(view.color[both]))
        yield TwinThing(name, ious[value], _take_median(errors), float(np.median(differences)))
