"""The stage on real scenes of blocks: what it proves, what it says of what cannot be, and what it never costs."""

import ctypes
import time
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from schemas.codec import encode
from schemas.config import Config
from schemas.curation import TaskAssessment
from schemas.outcome import Done, Outcome
from schemas.scene import ExportedScene
from schemas.tables import TRAJECTORIES
from schemas.trajectories import Grasps
from tableverse_factory.core.errors import ConfigError, ModelAccessError, ModelError
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.execution.arrays import decode_recording
from tableverse_factory.robotics.execution.replay import load_named_arm, replay_recording
from tableverse_factory.robotics.grasps.remote import POINTS
from tableverse_factory.robotics.motion import interfaces
from tableverse_factory.robotics.motion.rrt import RrtConnect
from tableverse_factory.robotics.robots.station import Station
from tableverse_factory.stages.export.export import export
from tableverse_factory.stages.trajectories import trajectories as trajectories_module
from tableverse_factory.stages.trajectories.preflight import check_trajectory_models
from tableverse_factory.stages.trajectories.search import select_diverse, split_by_stage
from tableverse_factory.stages.trajectories.trajectories import plan_trajectories
from tests.helpers.model_server import Scripted
from tests.helpers.simple_scenes import Solid, as_settled, box, curated, cylinder, layout

pytestmark = pytest.mark.heavy

SMALL, FLAT, HUGE = "obj_000", "obj_001", "obj_002"
SERVICES = Services(Path("unused"))


def task(number: int, x: str, relation: str, y: str, accepted: bool = True) -> TaskAssessment:
    words = f"put {x} {relation} {y}"
    return TaskAssessment(
        task_id=f"task_{number:03d}", instruction=words, x_id=x, y_id=y, relation=relation, source="rules",
        accepted=accepted, refusal="" if accepted else "says_who",
    )  # fmt: skip


@lru_cache(maxsize=1)
def scene() -> ExportedScene:
    """A block that can be gripped, a flat one that carries, and one that no gripper spans."""
    solids = [
        Solid(cylinder(0.02, 0.07), (-0.1, 0.0, 0.035)),
        Solid(box(0.12, 0.1, 0.03), (0.12, 0.05, 0.015)),
        Solid(box(0.14, 0.14, 0.1), (-0.02, 0.25, 0.05)),
    ]
    tasks = (
        task(0, SMALL, "on", FLAT),
        task(1, HUGE, "next to", FLAT),
        task(2, SMALL, "in", FLAT),
        task(3, SMALL, "to the left of", FLAT, accepted=False),
        task(4, SMALL, "to the right of", FLAT),
    )
    outcome = export(curated(as_settled(layout(solids)), tasks=tasks), Config(), np.random.default_rng(0), SERVICES)
    assert isinstance(outcome, Done)
    return outcome.value


def run(config: Config | None = None) -> ExportedScene:
    outcome = plan_trajectories(scene(), config or Config(), np.random.default_rng(5), SERVICES)
    assert isinstance(outcome, Done)
    return outcome.value


@pytest.fixture(scope="module")
def finished() -> ExportedScene:
    return run()


def test_every_accepted_task_has_its_row_and_its_true_ending(finished):
    rows = {row["task_id"]: row for row in finished.trajectory_rows}
    assert list(rows) == ["task_000", "task_001", "task_002", "task_004"]
    assert {name: (row["success"], row["reason"]) for name, row in rows.items()} == {
        "task_000": (True, None),
        "task_001": (False, "no_grasp"),
        "task_002": (False, "no_container"),
        "task_004": (True, None),
    }
    assert all(set(row) <= set(TRAJECTORIES.names) for row in rows.values())
    assert all(row["detail"] for row in rows.values() if not row["success"])


def test_what_is_called_a_success_is_one_from_the_saved_files_alone(finished):
    files = dict(finished.files)
    executed = [row for row in finished.trajectory_rows if row["arrays"]]
    assert len(executed) == 2
    for row in executed:
        saved = decode_recording(files[row["arrays"]])
        replay = replay_recording(files, row, saved, Station(files, load_named_arm(saved.robot)))
        assert replay.verdict.success == row["success"]


def test_nothing_that_was_exported_is_touched(finished):
    before, after = dict(scene().files), dict(finished.files)
    assert {name: data for name, data in after.items() if not name.startswith("trajectories/")} == before
    assert [name for name, _ in finished.files] == sorted(after)


@pytest.mark.slow  # the test of fewer tasks compares the bytes of the first one
def test_the_same_bytes_again(finished):
    assert encode(run()) == encode(finished)


def _crash() -> None:
    ctypes.string_at(0)


def _hang() -> None:
    time.sleep(3600)


@pytest.mark.parametrize(
    ("befall", "reason", "said"),
    [(_crash, "crash", "SIGSEGV"), pytest.param(_hang, "timeout", "6 s", marks=pytest.mark.slow)],
)
def test_a_planner_that_crashes_or_hangs_costs_that_task_alone(finished, monkeypatch, befall, reason, said):
    """Both tasks whose motions are planned carry the same object: only the place tells the first from the last."""
    undisturbed = trajectories_module.search_trajectory

    def searched(cell, task, rng):
        befalls["now"] = task["task_id"] == "task_000"
        return undisturbed(cell, task, rng)

    class Treacherous(RrtConnect):
        """Sound, but for the first task."""

        def plan_path(self, start, goal, space, rng):
            if befalls["now"]:
                befall()
            return super().plan_path(start, goal, space, rng)

    befalls = {"now": False}
    monkeypatch.setattr(trajectories_module, "search_trajectory", searched)
    monkeypatch.setitem(interfaces.PLANNERS, "rrt", Treacherous)
    config = Config.model_validate({"trajectories": {"task_deadline_s": 6.0}}) if befall is _hang else Config()
    lost = run(config)
    first, *others = lost.trajectory_rows
    assert (first["task_id"], first["success"], first["reason"]) == ("task_000", False, reason)
    assert said in first["detail"]
    assert others == list(finished.trajectory_rows[1:])
    assert [row["success"] for row in others] == [False, False, True]
    assert dict(lost.files) == {k: v for k, v in finished.files if k != "trajectories/task_000.npz"}


def _asking(url: str, cache: Path) -> Outcome[ExportedScene]:
    section = {"grasp_model": "graspgen", "grasp_url": url, "grasp_timeout_s": 5.0}
    config = Config.model_validate({"trajectories": section})
    return plan_trajectories(scene(), config, np.random.default_rng(5), Services(cache))


def test_no_task_is_failed_for_a_server_that_is_dead_or_refuses(server, tmp_path):
    server.say(Scripted({"error": "no such key"}, 401))
    with pytest.raises(ModelAccessError, match="401"):
        _asking(server.url, tmp_path)
    with pytest.raises(ModelError, match="connection failed") as raised:
        _asking("http://127.0.0.1:9", tmp_path)
    assert type(raised.value) is ModelError


def test_an_answer_that_is_none_costs_its_task(server, tmp_path):
    server.say(Scripted({"grasps": "all of them"}))
    outcome = _asking(server.url, tmp_path)
    assert isinstance(outcome, Done)
    details = [row["detail"] for row in outcome.value.trajectory_rows if row["reason"] == "exception"]
    assert details
    assert all("AnswerInvalidError: the grasp server answers" in detail for detail in details)


def test_what_is_missing_is_said_before_anything_waits_for_it(server, tmp_path):
    def section(**values):
        return Config.model_validate({"trajectories": values}).trajectories

    check_trajectory_models(section(), here=True)
    with pytest.raises(ConfigError, match=r"planner=curobo needs curobo.*rrt"):
        check_trajectory_models(section(planner="curobo"), here=False)
    with pytest.raises(ConfigError, match="no robot 'nobody'"):
        check_trajectory_models(section(robot="nobody"), here=True)
    asked = {"grasp_model": "graspgen", "grasp_timeout_s": 5.0}
    with pytest.raises(ModelError, match="connection failed"):
        check_trajectory_models(section(grasp_url="http://127.0.0.1:9", **asked), here=True)
    check_trajectory_models(
        section(grasp_url="http://127.0.0.1:9", **asked), here=False
    )  # the machine that asks is another
    server.say(Scripted({"grasps": [], "scores": []}))
    check_trajectory_models(section(grasp_url=server.url, **asked), here=True)
    assert len(server.asked[0]["points"]) == POINTS


def test_fewer_tasks_where_fewer_are_wanted(finished):
    config = Config.model_validate({"trajectories": {"max_tasks": 1}})
    fewer = run(config)
    assert [row["task_id"] for row in fewer.trajectory_rows] == ["task_000"]
    assert fewer.trajectory_rows[0] == finished.trajectory_rows[0]
    arrays = "trajectories/task_000.npz"
    assert dict(fewer.files)[arrays] == dict(finished.files)[arrays], "the same bytes again"


def _grasps(count: int, seed: int = 1) -> Grasps:
    rng = np.random.default_rng(seed)
    turns = Rotation.random(count, rng).as_matrix()
    return Grasps(turns, 0.05 * rng.normal(size=(count, 3)), np.full(count, 0.04), rng.random(count))


def test_stages_come_in_the_papers_order_and_no_grasp_comes_twice():
    grasps = _grasps(400)
    found = list(split_by_stage(grasps, -0.9))
    assert [stage for stage, _ in found] == [1, 2, 3]
    bounds = {1: (-1.01, -0.9), 2: (-0.9, 0.0), 3: (0.0, 1.01)}
    for stage, chosen in found:
        down = chosen.rotations[:, 2, 2]
        low, high = bounds[stage]
        assert ((down >= low) & (down <= high)).all()
    assert len(found[-1][1]) == 1


def test_grasps_that_are_tried_differ_and_the_best_is_among_them():
    grasps = _grasps(50)
    twice = Grasps(*(np.concatenate([part, part]) for part in (
        grasps.rotations, grasps.positions, grasps.widths, grasps.scores)))  # fmt: skip
    kept = select_diverse(twice)
    assert len(kept) <= 16
    assert (kept.positions[0] == grasps.positions[0]).all()
    assert len(np.unique(kept.positions, axis=0)) == len(kept)
