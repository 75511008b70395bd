"""The rows of a dataset as the gallery tells them: what entered, what was lost where, what is in each scene."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from schemas.identity import check_id
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Dataset

Row = Mapping[str, Any]

_MOST_REASONS = 60
"""That are offered; free text finds the others."""


@dataclass(frozen=True, slots=True)
class SceneRecord:
    """One scene with its rows.

    Attributes:
        row: Of scenes/.
        objects: Its rows of objects/, in order.
        tasks: Its rows of tasks/, in order.
        trajectories: Its rows of trajectories/, in order.
    """

    row: Row
    objects: Sequence[Row]
    tasks: Sequence[Row]
    trajectories: Sequence[Row]

    @property
    def scene_id(self) -> str:
        """Safe as a file name: `schemas.identity.check_id`."""
        return str(self.row["scene_id"])

    @property
    def title(self) -> str:
        """Its own name, where it has one."""
        return str(self.row["name"] or self.row["scene_id"])

    @property
    def why(self) -> str:
        """Code of the drop or kind of the failure; empty where the scene is done."""
        return str(self.row["reason"] or self.row["error_kind"] or "")

    @property
    def n_succeeded(self) -> int:
        """Trajectories that succeed in simulation."""
        return sum(bool(row["success"]) for row in self.trajectories)

    @property
    def n_tasks(self) -> int:
        """Tasks that are possible."""
        return sum(bool(task["accepted"]) for task in self.tasks)

    @property
    def penetration_m(self) -> float | None:
        """The deepest overlap of two objects in the exported scene, of their meshes or of their pieces [m]."""
        known = [self.row[key] for key in ("piece_penetration_m", "mesh_penetration_m")]
        return max((float(depth) for depth in known if depth is not None), default=None)

    @property
    def is_certified(self) -> bool:
        """Whether the exported scene was measured."""
        return None not in (self.row["at_rest"], self.row["colliding"], self.row["epsilon_m"])

    @property
    def labels(self) -> list[str]:
        """The name of each of its objects."""
        return [str(item["relabel_name"] or item["label"]) for item in self.objects]

    @property
    def names(self) -> list[str]:
        """Names of its objects, those that repeat with their number, the most frequent first."""
        counts = Counter(self.labels)
        return [name if n == 1 else f"{n} × {name}" for name, n in sorted(counts.items(), key=lambda c: (-c[1], c[0]))]


@dataclass(frozen=True, slots=True)
class GalleryLoss:
    """Scenes that one stage lost for one reason."""

    status: str
    stage: str
    why: str
    count: int


@dataclass(frozen=True, slots=True)
class StageStep:
    """A stage of the funnel: how many scenes left it, and whom it lost."""

    stage: str
    left: int
    losses: tuple[GalleryLoss, ...]


@dataclass(frozen=True, slots=True)
class Bar:
    """One bar of a chart; `share` of the longest."""

    name: str
    count: int
    share: float


@dataclass(frozen=True, slots=True)
class Chart:
    """Counts to draw: a histogram stands upright, a ranking lies."""

    title: str
    bars: tuple[Bar, ...]
    upright: bool


@dataclass(slots=True)
class Records:
    """Everything that the gallery shows besides pictures.

    Attributes:
        done: Scenes with files, in the dataset's order.
        lost: Dropped and failed scenes.
    """

    done: list[SceneRecord] = field(default_factory=list)
    lost: list[SceneRecord] = field(default_factory=list)

    @property
    def entered(self) -> int:
        """Scenes of the manifest whose shard is committed."""
        return len(self.done) + len(self.lost)

    @property
    def moves(self) -> bool:
        """Whether any scene has trajectories."""
        return any(scene.trajectories for scene in self.done)

    @property
    def certified(self) -> list[SceneRecord]:
        """The done scenes that were measured after they were exported."""
        return [scene for scene in self.done if scene.is_certified]

    @property
    def n_sound(self) -> int:
        """Of these, those that are at rest and do not collide."""
        return sum(scene.row["at_rest"] and not scene.row["colliding"] for scene in self.certified)

    @property
    def epsilon_m(self) -> float:
        """The deepest penetration that no certificate calls a collision [m]."""
        return max((scene.row["epsilon_m"] for scene in self.certified), default=0.0)

    def count(self, status: str) -> int:
        """Scenes of one status."""
        return len(self.done) if status == "done" else sum(scene.row["status"] == status for scene in self.lost)

    def reasons(self, unusable: Sequence[str]) -> tuple[tuple[str, int], ...]:
        """Why scenes were lost, or are not usable, with how many there are of each; the most frequent first.

        Args:
            unusable: The judge's codes of the scenes that are done.
        """
        counts = Counter([*(scene.why for scene in self.lost if scene.why), *unusable])
        return tuple(sorted(counts.items(), key=lambda item: (-item[1], item[0]))[:_MOST_REASONS])

    def funnel(self, stages: Sequence[str]) -> tuple[StageStep, ...]:
        """How many scenes left each stage; stages that lost scenes and are not listed come first."""
        losses = Counter((str(s.row["stage"]), str(s.row["status"]), s.why) for s in self.lost)
        by_stage: dict[str, list[GalleryLoss]] = defaultdict(list)
        for (stage, status, why), count in sorted(losses.items(), key=lambda item: (-item[1], item[0])):
            by_stage[stage].append(GalleryLoss(status, stage, why, count))
        left, steps = self.entered, []
        for stage in (*sorted(set(by_stage) - set(stages)), *stages):
            left -= sum(loss.count for loss in by_stage[stage])
            steps.append(StageStep(stage, left, tuple(by_stage[stage])))
        return tuple(steps)


@dataclass(frozen=True, slots=True)
class SceneFacts:
    """What the gallery takes from a scene's meta.json.

    Attributes:
        reason_codes: Why it is not usable.
        criteria: The judge's points by criterion.
        left_out: Objects that were seen but could not be placed, with the reason.
    """

    reason_codes: tuple[str, ...] = ()
    criteria: tuple[tuple[str, str], ...] = ()
    left_out: tuple[tuple[str, str], ...] = ()


def scene_facts(meta: Mapping[str, Any]) -> SceneFacts:
    """The facts, as text.

    Raises:
        ValueError: if meta.json is not of the form that export gives it.
    """
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
    """All rows of a dataset.

    Raises:
        InputError: if the id of a done scene is not safe as a file name.
    """
    objects, tasks, tried = (_by_scene(table) for table in (dataset.objects, dataset.tasks, dataset.trajectories))
    records = Records()
    for row in dataset.scenes.to_table().to_pylist():
        scene_id = row["scene_id"]
        if row["status"] == "done" and row["tar_offset"] is not None:
            _check(scene_id)
            things, asked, done = (table.get(scene_id, []) for table in (objects, tasks, tried))
            records.done.append(SceneRecord(row, things, asked, done))
        else:
            records.lost.append(SceneRecord(row, (), (), ()))
    return records


def _check(scene_id: str) -> None:
    try:
        check_id(scene_id)
    except ValueError as error:
        raise InputError(f"the dataset is damaged: scene {error}") from error


def _by_scene(table: Any) -> dict[str, list[Row]]:
    rows: dict[str, list[Row]] = defaultdict(list)
    for row in table.to_table().to_pylist():
        rows[row["scene_id"]].append(row)
    return rows


def bars(counts: Mapping[str, int], most: int, by_count: bool = True) -> tuple[Bar, ...]:
    """The `most` largest counts as bars, or the first ones in their own order."""
    items = sorted(counts.items(), key=lambda item: (-item[1], item[0])) if by_count else list(counts.items())
    top = max((count for _, count in items), default=0) or 1
    return tuple(Bar(name, count, count / top) for name, count in items[:most])


def charts(records: Records) -> tuple[Chart, ...]:
    """Those of the overview."""
    objects = [item for scene in records.done for item in scene.objects]
    tasks = [task for scene in records.done for task in scene.tasks if task["accepted"]]
    names = Counter(name for scene in records.done for name in scene.labels)
    return (
        Chart("Objects per scene", _histogram([scene.row["n_objects"] for scene in records.done]), upright=True),
        Chart("Quality score", _histogram([scene.row["quality_score"] for scene in records.done], 1, 10), upright=True),
        Chart("Mass of an object, up to", _masses([item["mass_kg"] for item in objects]), upright=True),
        Chart("Most frequent objects", bars(names, 10), upright=False),
        Chart("Relations asked for", bars(Counter(str(task["relation"]) for task in tasks), 10), upright=False),
    )


_MASS_EDGES_G = (10, 30, 100, 300, 1000, 3000)


def _masses(masses_kg: Sequence[float | None]) -> tuple[Bar, ...]:
    names = [*(_grams(edge) for edge in _MASS_EDGES_G), "more"]
    counts = dict.fromkeys(names, 0)
    for mass in masses_kg:
        if mass is not None:
            counts[names[sum(1000 * mass >= edge for edge in _MASS_EDGES_G)]] += 1
    return bars(counts, len(names), by_count=False)


def _grams(grams: int) -> str:
    return f"{grams} g" if grams < 1000 else f"{grams // 1000} kg"


def _histogram(values: Sequence[int | None], low: int | None = None, high: int | None = None) -> tuple[Bar, ...]:
    """A bar per whole number, at most 16: longer ranges are put together by twos, fours, …."""
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
    return bars(counts, len(counts), by_count=False)
