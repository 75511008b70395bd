"""How a scene ended and what it took, as it stands in a committed shard or in the journal of an open one."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from schemas.outcome import ModelCost
from schemas.work import SceneResult, Status
from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.dataset.model_costs import COST_COLUMNS, make_cost_columns, sum_model_costs
from tableverse_factory.dataset.shards import read_shard, shard_path

_SCENES = ("scene_id", "status", "stage", "tar_size", *COST_COLUMNS)
_TIMINGS = ("scene_id", "stage", "cpu_s", "wall_s")


@dataclass(frozen=True, slots=True)
class SceneStatus:
    """A scene that is accounted for.

    Attributes:
        stage: The last stage that ran.
        timings: Of the stages that ran in the build that finished it: (stage, CPU [s], wall [s]).
        tar_bytes: Of its files in the shard; None where no shard holds them yet.
        costs: What the answers of its models cost, by who asked.
    """

    status: Status
    stage: str
    timings: tuple[tuple[str, float, float], ...]
    tar_bytes: int | None
    costs: Mapping[str, ModelCost]


def read_committed_scenes(out: StoragePath, shard: int) -> dict[str, SceneStatus]:
    """The scenes of a committed shard.

    Raises:
        FileNotFoundError: if the shard is being written again just now.
        BuildError: if a table is damaged.
    """
    timings: dict[str, list[tuple[str, float, float]]] = {}
    for row in _rows(out, "timings", shard, _TIMINGS):
        timings.setdefault(row["scene_id"], []).append((row["stage"], row["cpu_s"], row["wall_s"]))
    return {
        row["scene_id"]: SceneStatus(
            row["status"],
            row["stage"],
            tuple(timings.get(row["scene_id"], ())),
            row["tar_size"] or 0,
            sum_model_costs([row]),
        )
        for row in _rows(out, "scenes", shard, _SCENES)
    }


def make_scene_status(result: SceneResult) -> SceneStatus:
    """The same of a result in a journal."""
    return SceneStatus(
        result.status,
        result.stage,
        tuple((timing.stage, timing.cpu_s, timing.wall_s) for timing in result.timings),
        None,
        sum_model_costs([make_cost_columns(result.costs)]),
    )


def _rows(out: StoragePath, table: str, shard: int, columns: tuple[str, ...]) -> list[dict[str, Any]]:
    rows: list[dict[str, Any]] = read_shard(shard_path(out, table, shard), columns=columns).to_pylist()
    return rows
