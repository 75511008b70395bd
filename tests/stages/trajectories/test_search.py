"""What a row tells of how its task was searched: what was settled for, and of what all attempts failed."""

from collections import Counter
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest

from schemas.config import Config
from schemas.curation import TaskAssessment
from schemas.geometry import Pose
from schemas.outcome import Done
from schemas.scene import ExportedScene
from schemas.tables import TRAJECTORIES
from schemas.trajectories import Placement
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.motion import interfaces
from tableverse_factory.robotics.motion.rrt import RrtConnect
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.stages.export.export import export
from tableverse_factory.stages.trajectories.rows import MAX_DETAIL, build_trajectory_row
from tableverse_factory.stages.trajectories.search import (
    MAX_GRASPS,
    MAX_REASONS,
    Attempt,
    PlannedTask,
    _select_with_clearance,
    format_tally,
    move_grasps,
    search_trajectory,
    select_diverse,
)
from tableverse_factory.stages.trajectories.work_cell import WorkCell
from tests.helpers.simple_scenes import Solid, as_settled, box, curated, cylinder, layout

pytestmark = pytest.mark.heavy

SERVICES = Services(Path("unused"))
ASLANT = (np.cos(np.pi / 8), 0.0, 0.0, np.sin(np.pi / 8))
CONFIG = Config()


@lru_cache(maxsize=1)
def scene() -> ExportedScene:
    """A can, and another between two low walls that stand aslant: boxes around them leave no room beside it."""
    walls = [Solid(box(0.5, 0.01, 0.03), (0.15 + k, -k, 0.015), quaternion=ASLANT) for k in (-0.04, 0.04)]
    solids = [Solid(cylinder(0.02, 0.06), (-0.2, 0.1, 0.03)), Solid(cylinder(0.02, 0.06), (0.0, -0.15, 0.03)), *walls]
    task = TaskAssessment(
        task_id="task_000", instruction="put it there", x_id="obj_000", y_id="obj_001", relation="to the right of",
        source="rules", accepted=True, refusal="",
    )  # fmt: skip
    outcome = export(curated(as_settled(layout(solids)), tasks=(task,)), CONFIG, np.random.default_rng(0), SERVICES)
    assert isinstance(outcome, Done)
    return outcome.value


def cell() -> WorkCell:
    made, rng = scene(), np.random.default_rng(0)
    return WorkCell(dict(made.files), made.object_rows, load_arm("panda"), CONFIG.trajectories, rng, SERVICES)


def row_of(found: PlannedTask) -> dict:
    row = build_trajectory_row(scene().task_rows[0], CONFIG.trajectories, found, None)
    assert set(row) <= set(TRAJECTORIES.names)
    return row


def test_what_placement_and_motion_settled_for_stands_in_the_row():
    found = search_trajectory(cell(), scene().task_rows[0], np.random.default_rng(3))
    assert found.attempt is not None
    assert found.attempt.motion is not None, found.attempt.detail
    fallbacks = row_of(found)["fallbacks"]
    assert fallbacks[0] == "place: clear by outlines"
    assert fallbacks[1:] == list(found.attempt.motion.fallbacks)


@pytest.mark.slow  # a second search, for a count
def test_a_cell_has_one_planner_however_much_it_is_asked(monkeypatch):
    made = []

    class Counted(RrtConnect):
        def __init__(self) -> None:
            made.append(self)

        def plan_path(self, start, goal, space, rng):
            return None

    monkeypatch.setitem(interfaces.PLANNERS, "rrt", Counted)
    ours = cell()
    assert made == []  # the parent of the processes that search has none
    for seed in (1, 2):
        found = search_trajectory(ours, scene().task_rows[0], np.random.default_rng(seed))
    assert len(made) == 1
    assert found.tried == CONFIG.trajectories.tries
    assert row_of(found).get("fallbacks") is None
    assert row_of(found)["detail"].endswith(f"({found.detail})")
    assert "no_path" in found.detail


def test_where_none_of_the_first_grasps_has_room_those_that_have_are_tried():
    ours = cell()
    standing, grasps = ours.objects["obj_000"].pose, ours.grasps("obj_000")
    beside = Pose(np.array([-0.042, -0.15, standing.position[2]]), standing.quaternion_wxyz)  # 2 mm from the other can
    room = ours.has_room("obj_000", move_grasps(grasps, compose_poses(beside, invert_pose(standing))))
    order = np.concatenate([np.flatnonzero(~room), np.flatnonzero(room)]).astype(np.int32)
    stage, places = grasps.select(order), (Placement(beside, 0.0),)
    assert 0 < room.sum() < len(room)
    assert not ours.has_room(
        "obj_000", move_grasps(select_diverse(stage), compose_poses(beside, invert_pose(standing)))
    ).any()
    tried = _select_with_clearance(ours, "obj_000", stage, places)
    assert tried.at(0).any()
    assert 0 < len(tried.grasps) <= MAX_GRASPS
    blocked = grasps.select(np.flatnonzero(~room).astype(np.int32))
    assert len(_select_with_clearance(ours, "obj_000", blocked, places).grasps) == 0


@pytest.mark.parametrize(
    ("reasons", "words"),
    [
        ({"blocked": 1}, "1 try: 1 blocked"),
        ({"slipped": 4, "blocked": 8}, "12 tries: 8 blocked, 4 slipped"),
        ({"b": 2, "a": 2, "c": 3}, "7 tries: 3 c, 2 a, 2 b"),
        (dict.fromkeys("abcdefgh", 2), "16 tries: 2 a, 2 b, 2 c, 2 d, 2 e, 6 others"),
    ],
)
def test_the_tally_is_short_and_in_an_order_of_its_own(reasons, words):
    assert format_tally(Counter(reasons)) == words
    assert words.count(",") <= MAX_REASONS


def test_a_long_detail_is_cut_but_not_its_tally():
    base = Pose(np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
    attempt = Attempt(base, 1, 0.5, "grasp", "blocked", "x" * 2000)
    detail = row_of(PlannedTask(attempt, detail="12 tries: 12 blocked", tried=12))["detail"]
    assert len(detail) <= MAX_DETAIL
    assert detail.endswith("x (12 tries: 12 blocked)")
