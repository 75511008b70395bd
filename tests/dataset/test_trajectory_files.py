"""Rows and files of trajectories belong together when they are written, and are compared when they are verified."""

import hashlib

import pytest

from schemas.config import Config
from schemas.outcome import Failed
from schemas.scene import Certificate, ExportedScene
from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset.shards import check_exported
from tableverse_factory.dataset.trajectory_files import add_digests, arrays_name, find_changes
from tableverse_factory.stages.trajectories.failed_rows import with_failed_trajectories

CERTIFICATE = Certificate(0.001, *[0.0] * 6, (), (), (), True, False)
TASKS = tuple({"scene_id": "a", "task_id": f"task_{k:03d}", "accepted": k < 3} for k in range(4))
GOOD = {"scene_id": "a", "task_id": "task_000", "success": True, "arrays": "trajectories/task_000.npz"}
FAILED = {"scene_id": "a", "task_id": "task_001", "success": False, "reason": "no_grasp"}


def scene(rows: list[dict], files: dict[str, bytes] | None = None) -> ExportedScene:
    files = {"trajectories/task_000.npz": b"x"} if files is None else files
    members = tuple(sorted({"scene.xml": b"<mujoco/>", **files}.items()))
    return ExportedScene("a", members, CERTIFICATE, {}, (), TASKS, tuple(rows))


def test_what_belongs_together_passes():
    check_exported(scene([GOOD, FAILED]), "a")
    check_exported(scene([], {}), "a")


@pytest.mark.parametrize(
    ("rows", "files", "why"),
    [
        ([GOOD, GOOD], None, "stands there already"),
        ([{**GOOD, "task_id": "task_009"}], None, "none of the scene's tasks"),
        ([{**GOOD, "task_id": None}], None, "none of the scene's tasks"),
        ([{**GOOD, "arrays": "assets/task_000.npz"}], None, "is not the file of 'task_000'"),
        ([GOOD], {}, "not among the scene's files"),
        ([{**GOOD, "arrays": None}], {}, "no file holds its motion"),
        ([FAILED], None, "'trajectories/task_000.npz' belongs to no row"),
        ([{**GOOD, "scene_id": "b"}], None, "must name its scene"),
        ([{**GOOD, "lifted_m": "high"}], None, "does not fit the trajectory table"),
        ([{**GOOD, "colour": "red"}], None, "unknown columns"),
    ],
)
def test_what_does_not_is_never_committed(rows, files, why):
    with pytest.raises(BuildError, match=why):
        check_exported(scene(rows, files), "a")


def test_what_changed_after_it_was_written_is_found():
    written = scene([GOOD, FAILED])
    rows, files = add_digests(written.trajectory_rows, written.files), dict(written.files)
    assert rows[0]["arrays_sha256"] == hashlib.sha256(b"x").hexdigest()
    assert rows[1]["arrays_sha256"] is None
    its = {"n_trajectories": 2}
    assert list(find_changes(rows, files, its)) == []
    assert list(find_changes(rows, {**files, GOOD["arrays"]: b"y"}, its)) == [
        "'trajectories/task_000.npz' is not the file that was written"
    ]
    assert list(find_changes(rows, {"scene.xml": b""}, its)) == [
        "'trajectories/task_000.npz' is not the file that was written"
    ]
    assert "belongs to no row" in next(find_changes(rows, {**files, "trajectories/x.npz": b""}, its))
    assert list(find_changes(rows[:1], files, its)) == ["trajectories/ has 1 rows of it, and scenes/ says 2"]
    assert list(find_changes([], {}, {})) == []


def test_a_scene_that_was_given_up_says_so_for_each_task_that_was_to_be_tried():
    lost = with_failed_trajectories(
        scene([], {}), Config(trajectories={"max_tasks": 2}), Failed("timeout", "no answer within 5 s")
    )
    check_exported(lost, "a")
    assert [(row["task_id"], row["success"], row["reason"]) for row in lost.trajectory_rows] == [
        ("task_000", False, "timeout"),
        ("task_001", False, "timeout"),
    ]
    assert lost.trajectory_rows[0]["robot"] == "panda"
    assert (lost.scene_row["n_trajectories"], lost.scene_row["n_successes"]) == (2, 0)


@pytest.mark.parametrize("task_id", ["../x", "", ".hidden", "a/b", "x" * 81])
def test_a_task_whose_id_is_no_name_has_no_file(task_id):
    with pytest.raises(ValueError, match="is not usable"):
        arrays_name(task_id)
