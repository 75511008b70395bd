"""Rows of a dataset for the gallery: finished scenes, lost ones, and charts."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from schemas.identity import check_id
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.viz.funnel import SceneLoss
from tableverse_factory.viz.gallery.formatting import SCALE_NAMES

Row = Mapping[str, Any]

_MOST_REASONS = 60  # most reasons that the filter lists; free text finds the others


@dataclass(frozen=True, slots=True)
class SceneRecord:
    """A scene: its row of scenes/ and, in order, its rows of objects/, tasks/ and trajectories/."""

    row: Row
    objects: Sequence[Row]
    tasks: Sequence[Row]
    trajectories: Sequence[Row]

    @property
    def scene_id(self) -> str:
        """Id, safe as a file name (`schemas.identity.check_id`)."""
        return str(self.row["scene_id"])

    @property
    def title(self) -> str:
        """Name of the scene, else its id."""
        return str(self.row["name"] or self.row["scene_id"])

    @property
    def reason(self) -> str:
        """Code of the drop or kind of the failure; empty for a finished scene."""
        return str(self.row["reason"] or self.row["error_kind"] or "")

    @property
    def n_succeeded(self) -> int:
        """Number of trajectories that succeed in simulation."""
        return sum(bool(row["success"]) for row in self.trajectories)

    @property
    def n_tasks(self) -> int:
        """Number of accepted tasks."""
        return sum(bool(task["accepted"]) for task in self.tasks)

    @property
    def penetration_m(self) -> float | None:
        """Deepest overlap of two objects in the exported scene, on meshes or pieces [m]."""
        known = [self.row[key] for key in ("piece_penetration_m", "mesh_penetration_m")]
        return max((float(depth) for depth in known if depth is not None), default=None)

    @property
    def is_certified(self) -> bool:
        """Whether the scene has a certificate."""
        return None not in (self.row["at_rest"], self.row["colliding"], self.row["epsilon_m"])

    @property
    def losses(self) -> list[str]:
        """Kinds of what toppled, slid, is left out or poorly covered, once each."""
        return sorted({str(remark).partition(":")[0] for remark in self.row["twin_remarks"] or ()})

    @property
    def labels(self) -> list[str]:
        """Name of each object."""
        return [str(item["relabel_name"] or item["label"]) for item in self.objects]

    @property
    def names(self) -> list[str]:
        """Names of the objects with their number where they repeat, the most frequent first."""
        counts = Counter(self.labels)
        return [name if n == 1 else f"{n} × {name}" for name, n in sorted(counts.items(), key=lambda c: (-c[1], c[0]))]


@dataclass(frozen=True, slots=True)
class Bar:
    """A bar of a chart; `share` is its count over the largest one."""

    name: str
    count: int
    share: float


@dataclass(frozen=True, slots=True)
class Chart:
    """A chart: an upright histogram or a horizontal ranking."""

    title: str
    bars: tuple[Bar, ...]
    upright: bool


@dataclass(slots=True)
class Records:
    """Finished scenes, and dropped or failed ones, in the order of the dataset."""

    done: list[SceneRecord] = field(default_factory=list)
    lost: list[SceneRecord] = field(default_factory=list)

    @property
    def entered(self) -> int:
        """Number of scenes of committed shards."""
        return len(self.done) + len(self.lost)

    @property
    def kinds(self) -> set[str]:
        """Kinds of input of all scenes, the lost ones included."""
        return {str(scene.row["kind"]) for scene in (*self.done, *self.lost)}

    @property
    def has_trajectories(self) -> bool:
        """Whether any scene has trajectories."""
        return any(scene.trajectories for scene in self.done)

    @property
    def certified(self) -> list[SceneRecord]:
        """Finished scenes with a certificate."""
        return [scene for scene in self.done if scene.is_certified]

    @property
    def n_sound(self) -> int:
        """Number of certified scenes that are at rest and free of collisions."""
        return sum(scene.row["at_rest"] and not scene.row["colliding"] for scene in self.certified)

    @property
    def epsilon_m(self) -> float:
        """Deepest penetration that no certificate counts as a collision [m]."""
        return max((scene.row["epsilon_m"] for scene in self.certified), default=0.0)

    def count(self, status: str) -> int:
        """Count the scenes of a status."""
        return len(self.done) if status == "done" else sum(scene.row["status"] == status for scene in self.lost)

    def count_reasons(self, unusable: Sequence[str]) -> tuple[tuple[str, int], ...]:
        """Count the reasons of lost scenes and the judge's codes of finished ones, the most frequent first."""
        counts = Counter([*(scene.reason for scene in self.lost if scene.reason), *unusable])
        return tuple(sorted(counts.items(), key=lambda item: (-item[1], item[0]))[:_MOST_REASONS])

    def list_scale_sources(self) -> list[tuple[str, str]]:
        """List where the metres of the finished scenes come from, each once, with its words."""
        there = {scene.row["scale_source"] for scene in self.done}
        return [(source, words) for source, words in SCALE_NAMES.items() if source in there]

    def list_losses(self) -> list[SceneLoss]:
        """List the losses by stage, status and reason, the largest first."""
        losses = Counter((str(s.row["stage"]), str(s.row["status"]), s.reason) for s in self.lost)
        ordered = sorted(losses.items(), key=lambda item: (-item[1], item[0]))
        return [SceneLoss(*key, count) for key, count in ordered]


@dataclass(frozen=True, slots=True)
class SceneFacts:
    """Facts of meta.json."""

    reason_codes: tuple[str, ...] = ()  # the judge's reasons why the scene is not usable
    criteria: tuple[tuple[str, str], ...] = ()  # the judge's points by criterion
    left_out: tuple[tuple[str, str], ...] = ()  # objects that could not be placed, with the reason


def read_scene_facts(meta: Mapping[str, Any]) -> SceneFacts:
    """Read the facts of meta.json as text; raise a `ValueError` if it is not as export writes it."""
    try:
        assessment = meta["assessment"]
        return SceneFacts(
            tuple(str(code) for code in assessment["reason_codes"]),
            tuple((str(name), str(points)) for name, points in assessment["criterion_scores"].items()),
            tuple((str(object_id), str(reason)) for object_id, reason in meta["left_out"]),
        )
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"meta.json is not of a scene: {type(error).__name__}: {error}") from error


def read_records(dataset: Dataset) -> Records:
    """Read all rows of a dataset; raise an `InputError` if the id of a done scene is not safe as a file name."""
    objects, tasks, tried = (_group_by_scene(table) for table in (dataset.objects, dataset.tasks, dataset.trajectories))
    records = Records()
    for row in dataset.scenes.to_table().to_pylist():
        scene_id = row["scene_id"]
        if row["status"] == "done" and row["tar_offset"] is not None:
            try:
                check_id(scene_id)
            except ValueError as error:
                raise InputError(f"the dataset is damaged: scene {error}") from error
            rows = (table.get(scene_id, []) for table in (objects, tasks, tried))
            records.done.append(SceneRecord(row, *rows))
        else:
            records.lost.append(SceneRecord(row, (), (), ()))
    return records


def _group_by_scene(table: Any) -> dict[str, list[Row]]:
    rows: dict[str, list[Row]] = defaultdict(list)
    for row in table.to_table().to_pylist():
        rows[row["scene_id"]].append(row)
    return rows


def make_bars(counts: Mapping[str, int], most: int, by_count: bool = True) -> tuple[Bar, ...]:
    """Make bars of the `most` largest counts, or of the first ones in their order."""
    items = sorted(counts.items(), key=lambda item: (-item[1], item[0])) if by_count else list(counts.items())
    top = max((count for _, count in items), default=0) or 1
    return tuple(Bar(name, count, count / top) for name, count in items[:most])


def make_charts(records: Records) -> tuple[Chart, ...]:
    """Make the charts of the first page."""
    objects = [item for scene in records.done for item in scene.objects]
    tasks = [task for scene in records.done for task in scene.tasks if task["accepted"]]
    names = Counter(name for scene in records.done for name in scene.labels)
    scores = [scene.row["quality_score"] for scene in records.done]
    return (
        Chart("Objects per scene", _count_integers([scene.row["n_objects"] for scene in records.done]), upright=True),
        Chart("Quality score", _count_integers(scores, 1, 10), upright=True),
        Chart("Mass of an object, up to", _count_masses([item["mass_kg"] for item in objects]), upright=True),
        Chart("Most frequent objects", make_bars(names, 10), upright=False),
        Chart("Relations asked for", make_bars(Counter(str(task["relation"]) for task in tasks), 10), upright=False),
    )


_MASS_EDGES_G = (10, 30, 100, 300, 1000, 3000)


def _count_masses(masses_kg: Sequence[float | None]) -> tuple[Bar, ...]:
    names = [*(f"{edge} g" if edge < 1000 else f"{edge // 1000} kg" for edge in _MASS_EDGES_G), "more"]
    counts = dict.fromkeys(names, 0)
    for mass in masses_kg:
        if mass is not None:
            counts[names[sum(1000 * mass >= edge for edge in _MASS_EDGES_G)]] += 1
    return make_bars(counts, len(names), by_count=False)


def _count_integers(values: Sequence[int | None], low: int | None = None, high: int | None = None) -> tuple[Bar, ...]:
    """Make a bar per integer, at most 16: bins of longer ranges hold two, four, … integers."""
    known = [int(value) for value in values if value is not None]
    if not known:
        return ()
    first = min(known) if low is None else low
    last = max(known) if high is None else high
    width = 1
    while (last - first) // width >= 16:
        width *= 2
    counts: dict[str, int] = {}
    for start in range(first, last + 1, width):
        name = str(start) if width == 1 else f"{start}–{start + width - 1}"
        counts[name] = sum(start <= value < start + width for value in known)
    return make_bars(counts, len(counts), by_count=False)
