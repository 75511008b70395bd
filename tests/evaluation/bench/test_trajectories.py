"""`tableverse bench trajectories`: every part of every task is measured."""

import json

import numpy as np
import pytest

from schemas.config import Config
from schemas.curation import TaskAssessment
from schemas.outcome import Done
from schemas.scene import ExportedScene
from tableverse_factory.evaluation.bench import trajectories as bench
from tableverse_factory.models.services import Services
from tableverse_factory.stages.export.export import export
from tests.helpers.simple_scenes import Solid, as_settled, box, curated, layout

pytestmark = pytest.mark.heavy

CONFIG = Config.model_validate({"trajectories": {"tries": 2, "placements": 6, "candidates": 400}})


def task(task_id: str, relation: str, **changes: object) -> TaskAssessment:
    values = {"instruction": "Put it.", "x_id": "obj_000", "y_id": "obj_001", "source": "rules", "accepted": True}
    return TaskAssessment.model_validate({**values, "task_id": task_id, "relation": relation, **changes})


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> ExportedScene:
    solids = [Solid(box(0.04, 0.05, 0.06), (-0.1, 0.0, 0.03)), Solid(box(0.08, 0.08, 0.05), (0.08, 0.05, 0.025))]
    tasks = (
        task("task_000", "next to"),
        task("task_001", "in"),
        task("task_002", "on", accepted=False, refusal="no_room"),
    )
    services = Services(tmp_path_factory.mktemp("cache"))
    outcome = export(curated(as_settled(layout(solids)), tasks=tasks), Config(), np.random.default_rng(0), services)
    assert isinstance(outcome, Done), outcome
    return outcome.value


@pytest.fixture(scope="module")
def costs(scene, tmp_path_factory) -> list[bench.TaskCost]:
    return bench.bench_trajectories([scene], CONFIG, Services(tmp_path_factory.mktemp("cache")))


def test_every_accepted_task_is_measured_and_what_fails_says_why(costs):
    assert [cost.relation for cost in costs] == ["next to", "in"]
    assert costs[1].ended == "no_container"
    assert bench.PLANNING not in costs[1].cpu_s
    json.dumps([cost.cpu_s for cost in costs])


def test_a_success_has_all_its_parts_and_they_are_less_than_the_whole(costs):
    done = costs[0]
    assert done.ended == ""
    parts = {bench.PLANNING, bench.IK, bench.PATH, bench.TIMING, bench.RECHECK, bench.ROLLOUT, bench.CHANGED}
    assert parts <= set(done.cpu_s)
    assert all(seconds >= 0.0 for seconds in done.cpu_s.values())
    assert done.cpu_s[bench.IK] < done.cpu_s[bench.PLANNING] < done.cpu_s[bench.WHOLE]


def test_rates_and_quantiles_count_every_task_once(costs):
    found = bench.count_outcomes(costs)
    assert found.tasks == {"in": 1, "next to": 1, bench.ALL: 2}
    assert found.succeeded == {"in": 0, "next to": 1, bench.ALL: 1}
    assert found.free == found.tasks, "the boxes stand 12 cm apart"
    assert found.free_succeeded == found.succeeded
    assert found.reasons == {"no_container": 1}
    assert set(found.survived.values()) <= {0.0, 1.0}
    count, median, high = bench.compute_quantiles(costs)[bench.WHOLE]
    assert count == 2
    assert 0.0 < median <= high
    assert bench.count_outcomes([]).tasks == {bench.ALL: 0}
    assert bench.compute_quantiles([]) == {}
    problems, solved, length_rad = bench.summarize_paths(costs)
    assert problems >= solved > 0
    assert length_rad > 0.0
    assert bench.summarize_paths([])[:2] == (0, 0)
