"""Trajectories from their saved arrays alone: success is reproduced to the bit, and what was tampered with is found."""

import json
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from schemas.config import TrajectoriesConfig
from schemas.curation import Relation
from schemas.tables import TABLES
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.shards import TarShard
from tableverse_factory.dataset.trajectory_files import add_digests
from tableverse_factory.robotics.execution.arrays import Recording, decode_recording, encode_recording
from tableverse_factory.robotics.execution.audit import audit_trajectories
from tableverse_factory.robotics.execution.execute import RolloutResult, execute_and_check
from tableverse_factory.robotics.execution.replay import ReplayDifference, load_named_arm, replay_recording
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.robotics.robots.station import Station
from tests.helpers.pick_recording import BASE, BLOCK, REFERENCE, exported, goal, pick_and_place, scene_files, station

pytestmark = pytest.mark.heavy

NAME = "trajectories/task_000.npz"
ASKED = "Put the small block next to the large one."
TASK = {"scene_id": "scene", "task_id": "task_000", "instruction": ASKED, "x_id": BLOCK, "y_id": REFERENCE}
TASK |= {"relation": Relation.NEXT_TO.value, "source": "rules", "accepted": True, "refusal": None}


@pytest.fixture(scope="module")
def good() -> RolloutResult:
    return execute_and_check(station(), BASE, pick_and_place(), goal())


def row_of(proof: RolloutResult, **changes: object) -> dict[str, object]:
    verdict = proof.verdict
    return {
        "scene_id": "scene",
        "task_id": "task_000",
        "relation": Relation.NEXT_TO.value,
        "x_id": BLOCK,
        "y_id": REFERENCE,
        "success": verdict.success,
        "reason": verdict.reason or None,
        "robot": "panda",
        "planner": "rrt",
        "grasp_model": "antipodal",
        "grasp_stage": 1,
        "instruction": ASKED,
        "duration_s": pick_and_place().duration_s,
        "survives": ["friction_halved", "mass_plus_30"] if verdict.success else None,
        "base_yaw_rad": np.pi / 2,
        "lifted_m": verdict.lifted_m,
        "disturbed_m": verdict.disturbed_m,
        **dict(zip(("base_x_m", "base_y_m", "base_z_m"), BASE.position.tolist(), strict=True)),
        "arrays": NAME,
        **changes,
    }


def problems(recording: Recording, row: dict[str, object], tasks: Sequence[dict[str, object]] = (TASK,)) -> str:
    files = {**scene_files(), NAME: encode_recording(recording)}
    (audit,) = audit_trajectories(files, [row], None, tasks, TrajectoriesConfig())
    return "; ".join(audit.problems)


def test_a_replay_from_the_files_alone_is_equal(good: RolloutResult) -> None:
    data = encode_recording(good.recording)
    fresh = Station(scene_files(), load_arm("panda"))
    again = replay_recording(scene_files(), row_of(good), decode_recording(data), fresh)
    assert again.verdict == good.verdict
    assert again.compute_difference() == ReplayDifference(0.0, 0.0, 0.0, 0.0, 0.0)
    assert encode_recording(again.now) == data, "and its recording is the same to the last byte"


@pytest.mark.parametrize("closed", [0.0, pytest.param(0.06, marks=pytest.mark.slow)])
def test_failures_are_reproduced_too(closed: float) -> None:
    failed = execute_and_check(station(), BASE, pick_and_place(place=(-0.15, 0.1, 0.03), closed=closed), goal())
    assert not failed.verdict.success
    assert replay_recording(scene_files(), row_of(failed), failed.recording, station()).verdict == failed.verdict
    assert problems(failed.recording, row_of(failed)) == ""
    assert "replayed it fails with" in problems(failed.recording, row_of(failed, reason="slipped"))


def test_an_honest_trajectory_passes(good: RolloutResult) -> None:
    assert problems(good.recording, row_of(good)) == ""
    assert audit_trajectories(scene_files(), [row_of(good, success=False, arrays=None)]) == ()


def test_tampered_arrays_are_found(good: RolloutResult) -> None:
    r, row = good.recording, row_of(good)
    opened, wrong, moved, shifted = (np.array(x) for x in (r.command, r.command, r.object_pose, r.qpos))
    opened[:, -1], wrong[250:, 0] = 0.07, wrong[250:, 0] + 0.3
    moved[100:, 0] += 0.01
    shifted[50, 2] += 0.02
    turned, told = np.array(r.object_pose), np.array(r.disturbed_m)
    turned[100:, 3:], told[100:] = [0.0, 0.0, 0.0, 1.0], 0.006
    gripper = np.array(r.tcp)
    gripper[50, 2] += 0.01
    still = np.tile(np.array([0.0, 0.3, 0.1, 1.0, 0.0, 0.0, 0.0], dtype=np.float32), (len(r), 1, 1))
    aside = replace(r.base, position=r.base.position + np.array([0.0, 0.1, 0.0]))
    cut = {
        name: getattr(r, name)[:255]
        for name in ("command", "phase", "time_s", "qpos", "qvel", "tcp", "object_pose", "moved_poses")
    }
    for recording, found in (
        (replace(r, command=opened), "a success by its row; replayed it fails in grasp: not_grasped"),
        (replace(r, command=wrong), "a success by its row; replayed it fails in place"),
        (replace(r, object_pose=moved), "replayed an object is 10.0 mm from where it was recorded"),
        (replace(r, object_pose=turned), "replayed an object is turned by 3.14 rad"),
        (replace(r, disturbed_m=told), "replayed displacements differ by 6.0 mm"),
        (replace(r, tcp=gripper), "replayed the gripper is 10.0 mm from"),
        (replace(r, moved_ids=(REFERENCE,), moved_poses=still), "replayed an object is"),
        (replace(r, moved_ids=("obj_777",), moved_poses=still), "obj_777 is recorded as moved, and is no other object"),
        (replace(r, moved_ids=(BLOCK,), moved_poses=still), f"{BLOCK} is recorded as moved, and is no other object"),
        (replace(r, max_disturbed_m=1e5), "its arrays say max_disturbed_m 100000, run.json 0.02"),
        (replace(r, qpos=shifted), "replayed a joint is 0.020 rad from where it was recorded"),
        (replace(r, base=aside), "a success by its row; replayed it fails in"),
        (replace(r, **cut, pads=r.pads[:255], disturbed_m=r.disturbed_m[:255]), "the motion ends in its phase place"),
        (replace(r, robot="other"), "no robot 'other'"),
        (replace(r, robot="/etc/arm.xml"), "its robot came from a file, /etc/arm.xml, that has to be given"),
    ):
        assert found in problems(recording, row)


LIES = (
    ({"success": False, "reason": "slipped"}, "a failure by its row ('slipped'); replayed it succeeds"),
    ({"lifted_m": 0.5}, "lifted_m: 0.5000 by its row"),
    ({"relation": Relation.RIGHT.value}, "relation_missed"),
    ({"arrays": None}, "there is no None to replay"),
)
MORE_LIES = (
    ({"robot": "menagerie:x"}, "its row says robot 'menagerie:x', its arrays 'panda'"),
    ({"base_x_m": 1.0}, "its row puts the base at [1.0"),
    ({"duration_s": 99.0}, "its row says that the motion takes 99.000 s, its arrays hold"),
    ({"survives": ["friction_halved", "nonsense"]}, "survives is ['friction_halved', 'nonsense']"),
    ({"disturbed_m": float("nan")}, "disturbed_m: nan by its row"),
    ({"base_x_m": None}, "its row has no base_x_m"),
    ({"base_yaw_rad": 1.0}, "its row turns the base by 1.0000 rad, its arrays by 1.5708 rad"),
    ({"base_yaw_rad": float("nan")}, "its row turns the base by nan rad"),
    ({"duration_s": float("inf")}, "its row says that the motion takes inf s"),
    ({"duration_s": -0.02}, "its row says that the motion takes -0.020 s"),
    ({"duration_s": pick_and_place().duration_s - 1.0}, "its arrays go on after that"),
    ({"duration_s": None}, "its row has no duration_s"),
    ({"survives": ["mass_plus_30", "mass_plus_30"]}, "each once, in this order"),
    ({"survives": None}, "it succeeded, and survives says nothing"),
    ({"grasp_stage": 7}, "grasp_stage is 7, and there are 1, 2 and 3"),
    ({"grasp_stage": None}, "grasp_stage is None"),
    ({"planner": "curobo"}, "its row says planner 'curobo', run.json 'rrt'"),
    ({"grasp_model": "graspgen"}, "its row says grasp_model 'graspgen', run.json 'antipodal'"),
    ({"instruction": "Dance."}, "its row says instruction 'Dance.', its task 'Put the small block"),
    ({"relation": Relation.OUTSIDE.value}, "its row says relation 'outside', its task 'next to'"),
    ({"y_id": "obj_002"}, "its row says y_id 'obj_002', its task 'obj_001'"),
    ({"y_id": BLOCK}, "cannot be brought into a relation to itself"),
    ({"task_id": "task_001"}, "its task stands in tasks/ 0 times"),
    ({"detail": "fell"}, "it succeeded, and its row has a detail"),
    ({"relation": "above"}, "there is no relation 'above'"),
    ({"y_id": "obj_9"}, "there is no assets/obj_9.obj"),
    ({"arrays": "trajectories/other.npz"}, "there is no trajectories/other.npz to replay"),
)


@pytest.mark.parametrize(
    ("changes", "found"), [*LIES, *(pytest.param(*lie, marks=pytest.mark.slow) for lie in MORE_LIES)]
)
def test_rows_that_lie_are_found(good: RolloutResult, changes: dict[str, object], found: str) -> None:
    assert found in problems(good.recording, row_of(good, **changes))


def test_a_task_has_to_be_asked_for_once_and_not_refused(good: RolloutResult) -> None:
    row = row_of(good)
    assert "its task was refused" in problems(good.recording, row, [{**TASK, "accepted": False}])
    assert "its task stands in tasks/ 2 times" in problems(good.recording, row, [TASK, TASK])


def test_a_bound_that_arrays_widen_is_not_believed() -> None:
    """With the bystander pushed by more than 20 mm it fails, whatever its arrays allow."""
    there = (0.04, 0.05, 0.05)
    wide = replace(goal(), max_disturbed_m=1e5)
    motion = pick_and_place(over=(0.0, 0.06, 0.06))
    pushed = execute_and_check(station(there), BASE, motion, wide)
    assert pushed.verdict.success, pushed.verdict
    files = {**scene_files(there), NAME: encode_recording(pushed.recording)}
    row = row_of(pushed, duration_s=motion.duration_s)
    (audit,) = audit_trajectories(files, [row], None, [TASK], TrajectoriesConfig())
    assert (audit.reproduced, "replayed it fails in" in audit.problems[0]) == (False, True)
    assert "disturbed" in audit.problems[0]
    (believed,) = audit_trajectories(files, [row])
    assert believed.problems == ()


@pytest.mark.parametrize("name", ["arm.xml", "/etc/passwd", "..\\arm", "menagerie:../../etc"])
def test_arrays_name_no_file(name: str) -> None:
    with pytest.raises((InputError, ConfigError)):
        load_named_arm(name)


def dataset_of(out: Path, rows: list[dict[str, object]], arrays: dict[str, bytes]) -> Path:
    """A dataset of this one scene."""
    for folder in ("mjcf", *TABLES):
        (out / folder).mkdir(parents=True)
    robot = str(rows[0]["robot"]) if rows else "panda"
    (out / "run.json").write_text(json.dumps({"config": {"trajectories": {"robot": robot}}}))
    scene = exported()
    rows = add_digests(rows, tuple(arrays.items()))
    with (out / "mjcf/shard-00000.tar").open("wb") as file:
        tar = TarShard(file)
        offset, size = tar.add(replace(scene, files=tuple(sorted({**dict(scene.files), **arrays}.items()))))
        tar.close()
    place = {"status": "done", "shard": 0, "tar_offset": offset, "tar_size": size}
    counts = {"n_trajectories": len(rows), "n_successes": sum(bool(row["success"]) for row in rows)}
    tables = {"scenes": [{**scene.scene_row, **place, **counts}], "objects": [], "trajectories": rows}
    tables["tasks"] = [{**TASK, "task_id": task_id} for task_id in ("task_000", "task_001", "task_002")]
    for name, schema in TABLES.items():
        (out / name / "shard-00000.parquet").write_bytes(encode_parquet(build_table(tables[name], schema)))
    return out


def test_verify_replays_a_dataset(good: RolloutResult, tmp_path: Path, run) -> None:
    failed = execute_and_check(station(), BASE, pick_and_place(closed=0.06), goal())
    other = "trajectories/task_001.npz"
    arrays = {NAME: encode_recording(good.recording), other: encode_recording(failed.recording)}
    rows = [
        row_of(good),
        row_of(failed, task_id="task_001", arrays=other),
        row_of(failed, task_id="task_002", arrays=None, reason="no_grasp", lifted_m=None, disturbed_m=None),
    ]
    code, out, _ = run("verify", dataset_of(tmp_path / "out", rows, arrays), "--trajectories")
    assert (code, "2 of 2 trajectories reproduced" in out) == (0, True), out
    rows[1] = {**rows[1], "success": True}
    code, out, _ = run("verify", dataset_of(tmp_path / "lies", rows, arrays), "--trajectories", "--json")
    report = json.loads(out)
    assert (code, report["ok"], report["verified"]) == (1, False, 0)
    assert [it["reproduced"] for it in report["scenes"][0]["trajectories"]] == [True, False]
    assert "task_001: a success by its row; replayed it fails in grasp" in report["scenes"][0]["problems"][0]
    rows = [row_of(good), row_of(failed, task_id="task_009", arrays=other)]
    code, out, _ = run("verify", dataset_of(tmp_path / "strange", rows, arrays), "--trajectories")
    assert (code, "a trajectory of 'task_009', which is none of the scene's tasks" in out) == (1, True), out


def test_a_dataset_that_does_not_say_what_made_it_is_not_verified(good: RolloutResult, tmp_path: Path, run) -> None:
    out = dataset_of(tmp_path / "out", [row_of(good)], {NAME: encode_recording(good.recording)})
    (out / "run.json").write_text("{}")
    code, _, err = run("verify", out, "--trajectories")
    assert (code, "run.json: it holds no configuration" in err) == (1, True), err
    (out / "run.json").unlink()
    code, _, err = run("verify", out, "--trajectories")
    assert (code, "run.json" in err) == (1, True), err


def test_verify_replays_nothing_but_datasets(tmp_path: Path, run) -> None:
    (tmp_path / "scene.xml").write_bytes(scene_files()["scene.xml"])
    code, _, err = run("verify", tmp_path, "--trajectories")
    assert (code, "--trajectories needs a dataset" in err) == (1, True)
    code, _, err = run("verify", dataset_of(tmp_path / "without", [], {}), "--trajectories")
    assert (code, "no trajectories to replay" in err) == (1, True)


def test_an_arm_from_a_file_is_given_again(good: RolloutResult, tmp_path: Path, run) -> None:
    spec = load_arm("panda").spec()
    spec.add_key(name="home", qpos=[*load_arm("panda").home, *load_arm("panda").finger_open])
    spec.compile()
    (tmp_path / "mine.xml").write_text(spec.to_xml().replace('<size nkey="1"/>', ""))
    mine = load_arm(str(tmp_path / "mine.xml"))
    there = Station(scene_files(), mine, BASE)
    proof = execute_and_check(there, BASE, pick_and_place(), goal())
    assert proof.verdict.success, proof.verdict
    rows = [row_of(proof, robot=mine.name)]
    out = dataset_of(tmp_path / "out", rows, {NAME: encode_recording(proof.recording)})
    code, _, err = run("verify", out, "--trajectories")
    assert (code, "give that file with --robot" in err) == (1, True), err
    code, text, _ = run("verify", out, "--trajectories", "--robot", tmp_path / "mine.xml")
    assert (code, "1 of 1 trajectories reproduced" in text) == (0, True), text
