"""A LeRobot dataset read back by pyarrow, JSON and PyAV alone, field by field after the layout of its version 3.0."""

import hashlib
import json
from dataclasses import replace
from pathlib import Path

import av
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
import yaml

from schemas.trajectories import Phase
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Scene, open_dataset
from tableverse_factory.delivery.episodes.instructions import paraphrase_instruction
from tableverse_factory.delivery.episodes.lerobot import LeRobotOptions, export_lerobot
from tableverse_factory.delivery.episodes.observation import pad_objects, read_object_poses
from tableverse_factory.delivery.episodes.selection import Episode
from tableverse_factory.robotics.execution.arrays import encode_recording
from tableverse_factory.robotics.robots.registry import load_arm
from tests.helpers.recorded_dataset import (
    STEP_S,
    recording,
    scene_members,
    trajectory_row,
    two_scenes,
    write_recorded_dataset,
)

pytestmark = pytest.mark.heavy

SMALL = {"width": 64, "height": 48}
CAMERAS = ["observation.images.front", "observation.images.scene"]
LENGTHS = [41, 31, 31]
DTYPES = {"float32": pa.float32(), "int64": pa.int64(), "bool": pa.bool_(), "string": pa.string()}
ORIGIN = {"split": "train", "paraphrases": [], "scene_id": "a-1", "success": True, "licence": ""}
FIGURES = ("min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99")


@pytest.fixture(scope="module")
def made(out, tmp_path_factory) -> Path:
    dest = tmp_path_factory.mktemp("lerobot") / "made"
    written = export_lerobot(open_dataset(out), dest, LeRobotOptions(failed=True, pictures=("front", "scene"), **SMALL))
    assert (written.episodes, written.frames, written.pictures) == (3, sum(LENGTHS), ("front", "scene"))
    return dest


@pytest.fixture(scope="module")
def info(made) -> dict:
    return json.loads((made / "meta/info.json").read_text())


@pytest.fixture(scope="module")
def data(made) -> pa.Table:
    return pq.read_table(made / "data/chunk-000/file-000.parquet")


@pytest.fixture(scope="module")
def episodes(made) -> list[dict]:
    return pq.read_table(made / "meta/episodes/chunk-000/file-000.parquet").to_pylist()


def test_the_files_are_those_of_the_layout_and_nothing_else(made):
    names = sorted(path.relative_to(made).as_posix() for path in made.rglob("*") if path.is_file())
    assert names == [
        "README.md",
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/info.json",
        "meta/stats.json",
        "meta/tasks.parquet",
        *(f"videos/{key}/chunk-000/file-000.mp4" for key in CAMERAS),
    ]


def test_info_says_what_is_there(made, info):
    assert info["codebase_version"] == "v3.0"
    assert info["robot_type"] == "panda"
    assert info["fps"] == round(1 / STEP_S)
    totals = (info["total_episodes"], info["total_frames"], info["total_tasks"])
    assert totals == (3, sum(LENGTHS), 2)
    assert info["splits"] == {"train": "0:3"}
    assert (info["chunks_size"], info["data_files_size_in_mb"], info["video_files_size_in_mb"]) == (1000, 100, 200)
    place = {"chunk_index": 0, "file_index": 0}
    assert (made / info["data_path"].format(**place)).is_file()
    for key in CAMERAS:
        assert (made / info["video_path"].format(video_key=key, **place)).is_file()
        video = info["features"][key]
        assert (video["dtype"], video["shape"], video["names"]) == (
            "video",
            [48, 64, 3],
            ["height", "width", "channels"],
        )
        expected = {"video.height": 48, "video.width": 64, "video.codec": "h264", "video.pix_fmt": "yuv420p"}
        more = {"video.is_depth_map": False, "video.fps": 20, "video.channels": 3, "has_audio": False}
        assert video["info"] == expected | more


def test_columns_are_the_features_with_their_types_and_names(info, data):
    features = {name: feature for name, feature in info["features"].items() if feature["dtype"] != "video"}
    assert data.column_names == list(features)
    for name, feature in features.items():
        kind, size = DTYPES[feature["dtype"]], feature["shape"]
        assert data.schema.field(name).type == (kind if size == [1] else pa.list_(kind, size[0]))
        assert feature["names"] is None or len(feature["names"]) == size[0]
        assert "/" not in name
    assert {"timestamp", "frame_index", "episode_index", "index", "task_index"} <= set(features)
    assert features["timestamp"] == {"dtype": "float32", "shape": [1], "names": None}


def test_frames_are_counted_as_the_format_counts_them(data):
    assert data["index"].to_pylist() == list(range(sum(LENGTHS)))
    assert data["frame_index"].to_pylist() == [k for length in LENGTHS for k in range(length)]
    assert data["episode_index"].to_pylist() == [n for n, length in enumerate(LENGTHS) for _ in range(length)]
    times = np.array([k * STEP_S for length in LENGTHS for k in range(length)])
    assert np.abs(data["timestamp"].to_numpy() - times).max() < 1e-6
    done = np.flatnonzero(data["next.done"].to_numpy(zero_copy_only=False)).tolist()
    assert done == (np.cumsum(LENGTHS) - 1).tolist()
    success = np.flatnonzero(data["next.success"].to_numpy(zero_copy_only=False)).tolist()
    assert success == [40, 102]


def test_state_and_action_are_the_recorded_ones(data):
    """An action is the command that leads to the next frame, in radians and metres."""
    taken, rows = recording(), data.slice(0, 41)
    state, action = (np.array(rows[name].to_pylist()) for name in ("observation.state", "action"))
    assert state.shape == (41, 22)
    assert (state[:, :7] == taken.qpos[:, :7]).all()
    assert (state[:, 7:14] == taken.qvel[:, :7]).all()
    assert state[:, 14] == pytest.approx(2 * taken.qpos[:, 7], abs=1e-6)
    assert (state[:, 15:] == taken.tcp).all()
    assert (action[:-1] == taken.command[1:].astype(np.float32)).all()
    assert (action[-1] == taken.command[-1].astype(np.float32)).all()
    assert rows["phase"].to_pylist() == taken.phase.tolist()
    assert rows["subtask"].to_pylist() == [list(Phase)[k].value.replace("_", "-") for k in taken.phase]


def test_objects_are_the_carried_one_then_the_reference_then_zeros(info, data):
    objects = np.array(data.slice(0, 41)["observation.environment_state"].to_pylist())
    names = info["features"]["observation.environment_state"]["names"]
    assert (names[0], names[7], len(names)) == ("carried.x", "reference.x", 14)
    assert (objects[:, :7] == recording().object_pose).all()
    assert objects[:, 7:] == pytest.approx(np.tile([0, 0, 0.03, 1, 0, 0, 0], (41, 1)), abs=1e-7)
    pushed = open_episode_of(recording(pushed=True))
    assert read_object_poses(pushed.scene.model(), pushed)[:, 1] == pytest.approx(
        pushed.recording.moved_poses[:, 0], abs=1e-7
    )
    assert (pad_objects(np.ones((4, 2, 7)), 3)[:, 2] == 0).all()
    strange = replace(recording(), moved_ids=("table",), moved_poses=recording(pushed=True).moved_poses)
    with pytest.raises(InputError, match="'table' is no object that can move"):
        read_object_poses(pushed.scene.model(), open_episode_of(strange))


def open_episode_of(taken):
    return Episode(trajectory_row("a-1", "task_000", True), Scene("a-1", {}, scene_members("a-1")), taken)


def test_the_card_leads_datasets_to_the_frames(made, episodes):
    text = (made / "README.md").read_text()
    head = yaml.safe_load(text.split("---")[1])
    assert head["license"] == "cc0-1.0"
    for config, rows in (("default", sum(LENGTHS)), ("episodes", 3)):
        (pattern,) = [each["data_files"] for each in head["configs"] if each["config_name"] == config]
        assert sum(pq.read_metadata(path).num_rows for path in made.glob(pattern)) == rows
    assert "3 episodes of the robot panda on 2 scenes, 103 frames; successes: 2." in text
    assert [e["split"] for e in episodes] == ["train"] * 3
    assert [e["paraphrases"] for e in episodes] == [[]] * 3, "these instructions are of no template"


def test_an_instruction_is_said_in_three_other_ways():
    said = paraphrase_instruction("Pick up the red mug on the left and place it to the right of the bowl.")
    assert said == (
        "Put the red mug on the left to the right of the bowl",
        "Move the red mug on the left so that it is to the right of the bowl",
        "Grasp the red mug on the left, carry it over and set it down to the right of the bowl",
    )
    assert paraphrase_instruction("Pick up {x.__class__} and place it on {y}")[0] == "Put {x.__class__} on {y}"
    assert paraphrase_instruction("Stack them all") == ()


def test_tasks_are_indexed_by_their_sentence(made, data, episodes):
    table = pq.read_table(made / "meta/tasks.parquet")
    tasks = dict(zip(table["task"].to_pylist(), table["task_index"].to_pylist(), strict=True))
    assert tasks == {"Put the green block on the red block.": 0, "Move the green block.": 1}
    assert json.loads(table.schema.metadata[b"pandas"])["index_columns"] == ["task"]
    first, second = tasks
    assert [episode["tasks"] for episode in episodes] == [[name] for name in (first, first, second)]
    assert data["task_index"].to_pylist() == [0] * 72 + [1] * 31


def test_episodes_say_where_their_frames_lie(episodes):
    ends = np.cumsum(LENGTHS).tolist()
    assert [e["episode_index"] for e in episodes] == [0, 1, 2]
    assert [e["length"] for e in episodes] == LENGTHS
    assert [e["dataset_from_index"] for e in episodes] == [0, *ends[:-1]]
    assert [e["dataset_to_index"] for e in episodes] == ends
    for prefix in ("data", "meta/episodes", *(f"videos/{key}" for key in CAMERAS)):
        assert {(e[f"{prefix}/chunk_index"], e[f"{prefix}/file_index"]) for e in episodes} == {(0, 0)}
    for key in CAMERAS:
        starts, stops = ([e[f"videos/{key}/{side}_timestamp"] for e in episodes] for side in ("from", "to"))
        assert stops == pytest.approx([end * STEP_S for end in ends])
        assert starts == pytest.approx([0.0, *stops[:-1]])
    assert [e["success"] for e in episodes] == [True, False, True]
    assert [(e["failed_phase"], e["reason"]) for e in episodes][1] == ("grasp", "not_grasped")
    assert [(e["scene_id"], e["task_id"]) for e in episodes][2] == ("b-2", "task_000")
    assert {e["licence"] for e in episodes} == {"CC0-1.0"}


def test_figures_of_episodes_and_of_all_are_those_of_the_numbers(made, info, data, episodes):
    stats = json.loads((made / "meta/stats.json").read_text())
    assert set(stats) == set(info["features"]) - {"next.done", "next.success", "subtask"}
    names = ("observation.state", "observation.environment_state", "action", "timestamp", "index")
    for name in names:
        values = np.array(data[name].to_pylist(), dtype=np.float64).reshape(sum(LENGTHS), -1)
        for key, value in (("min", values.min(0)), ("max", values.max(0)), ("mean", values.mean(0))):
            assert stats[name][key] == pytest.approx(value.tolist(), abs=1e-9)
        assert stats[name]["std"] == pytest.approx(values.std(axis=0).tolist(), abs=1e-9)
        assert stats[name]["count"] == [sum(LENGTHS)]
        own = values[41:72]
        assert episodes[1][f"stats/{name}/mean"] == pytest.approx(own.mean(axis=0).tolist(), abs=1e-9)
        assert episodes[1][f"stats/{name}/q90"] == pytest.approx(np.quantile(own, 0.9, axis=0).tolist(), abs=1e-9)
    for key in CAMERAS:
        for figure in FIGURES:
            assert np.shape(stats[key][figure]) == ((1,) if figure == "count" else (3, 1, 1))
            assert np.shape(episodes[0][f"stats/{key}/{figure}"]) == np.shape(stats[key][figure])
        assert 0.0 <= np.min(stats[key]["min"]) < np.min(stats[key]["mean"]) < np.max(stats[key]["max"]) <= 1.0


def test_every_frame_is_shown_at_its_timestamp(made, data, episodes):
    """Frames are found by time, as readers do: an episode's begin where its row says, and show its own pictures."""
    for key in CAMERAS:
        with av.open(str(made / f"videos/{key}/chunk-000/file-000.mp4")) as container:
            stream = container.streams.video[0]
            assert (stream.codec_context.name, stream.pix_fmt, stream.average_rate) == ("h264", "yuv420p", 20)
            assert (stream.codec_context.width, stream.codec_context.height) == (64, 48)
            shown = [(frame.time, frame.to_ndarray(format="rgb24")) for frame in container.decode(stream)]
        assert len(shown) == sum(LENGTHS)
        starts = np.repeat([e[f"videos/{key}/from_timestamp"] for e in episodes], LENGTHS)
        times = starts + data["timestamp"].to_numpy()
        assert np.abs(np.array([time for time, _ in shown]) - times).max() < 1e-4
        first, second = shown[41][1].astype(int), shown[40][1].astype(int)
        assert np.abs(first - second).mean() > 0.4  # another episode begins, far from where the first one ended
        same = np.abs(shown[41][1].astype(int) - shown[72][1].astype(int)).mean()
        assert same < 2.0  # the same recording in both scenes


def test_only_successes_are_taken_unless_failures_are_wanted(out, tmp_path):
    options = LeRobotOptions(width=32, height=24, fps=4)
    assert export_lerobot(open_dataset(out), tmp_path / "made", options).episodes == 2
    rows = pq.read_table(tmp_path / "made/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row["success"] for row in rows] == [True, True]
    assert [row["length"] for row in rows] == [9, 7]
    assert not (tmp_path / "made/videos/observation.images.scene").exists()


def test_a_slower_rhythm_acts_towards_its_own_next_frame(out, tmp_path):
    export_lerobot(open_dataset(out), tmp_path / "made", LeRobotOptions(width=32, height=24, fps=4))
    action = np.array(pq.read_table(tmp_path / "made/data")["action"].to_pylist()[:9])
    command = recording().command.astype(np.float32)
    assert (action == command[[5, 10, 15, 20, 25, 30, 35, 40, 40]]).all()


@pytest.mark.parametrize("jobs", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_the_same_bytes_again_however_many_processes_draw(out, tmp_path, jobs):
    options = {"width": 32, "height": 24, "fps": 4, "failed": True}
    export_lerobot(open_dataset(out), tmp_path / "a", LeRobotOptions(**options))
    export_lerobot(open_dataset(out), tmp_path / "b", LeRobotOptions(**options, jobs=jobs))
    assert digest(tmp_path / "a") == digest(tmp_path / "b")


def digest(folder: Path) -> dict[str, str]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_files_are_closed_at_their_bounds(out, tmp_path):
    """Episodes stay whole; a new file begins before the bound is passed, and its clock at zero."""
    from tableverse_factory.delivery.episodes.frames import list_features
    from tableverse_factory.delivery.episodes.lerobot_files import LeRobotFiles
    from tableverse_factory.delivery.episodes.render_workers import RenderSetting, render_episode
    from tableverse_factory.delivery.episodes.selection import get_kind, open_episode, select_rows

    row = select_rows(open_dataset(out), failed=False)[0]
    setting = RenderSetting(get_kind(open_episode(open_dataset(out), row)), ("front",), 32, 24, 5, 4, 2)
    shot = render_episode(str(out), setting, row)
    megabytes = 2.5 * len(shot.videos[CAMERAS[0]]) / 1024**2
    files = LeRobotFiles(tmp_path / "made", setting, list_features(load_arm("panda"), 2), 0.002, megabytes)
    for _ in range(5):
        files.add("Do it.", shot, ORIGIN)
    files.finish()
    rows = pq.read_table(tmp_path / "made/meta/episodes/chunk-000/file-000.parquet").to_pylist()
    assert [row[f"videos/{CAMERAS[0]}/file_index"] for row in rows] == [0, 0, 1, 1, 2]
    starts = [row[f"videos/{CAMERAS[0]}/from_timestamp"] for row in rows]
    assert starts == [0.0, 2.25, 0.0, 2.25, 0.0]
    assert [row["data/file_index"] for row in rows] == [0, 1, 2, 3, 4]
    for index, row in enumerate(rows):
        table = pq.read_table(tmp_path / f"made/data/chunk-000/file-{row['data/file_index']:03d}.parquet")
        assert set(table["episode_index"].to_pylist()) == {index}
        assert table["index"].to_pylist() == list(range(row["dataset_from_index"], row["dataset_to_index"]))


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"width": 33}, "bad_size"),
        ({"fps": 7}, "bad_fps"),
        ({"fps": 40}, "bad_fps"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_written(out, tmp_path, options, reason):
    with pytest.raises(InputError) as refused:
        export_lerobot(open_dataset(out), tmp_path / "made", LeRobotOptions(**options))
    assert refused.value.reason == reason
    assert list(tmp_path.iterdir()) == []


def test_nothing_is_overwritten_and_nothing_half_made_stays(out, tmp_path):
    (tmp_path / "made").mkdir()
    with pytest.raises(InputError, match="already there"):
        export_lerobot(open_dataset(out), tmp_path / "made", LeRobotOptions())
    damaged = [
        (trajectory_row("a-1", "task_000", True), encode_recording(recording(6))),
        (trajectory_row("a-1", "task_001", True), b"PK no arrays"),
    ]
    source = write_recorded_dataset(tmp_path / "out", {"a-1": damaged})
    with pytest.raises(InputError, match=r"task_001\.npz"):
        export_lerobot(open_dataset(source), tmp_path / "other", LeRobotOptions(width=32, height=24))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["made", "out"]


def test_robots_and_rhythms_are_not_mixed(tmp_path):
    slow = replace(recording(6), step_s=0.1, time_s=(np.arange(6) * 0.1).astype(np.float32))
    rows = [
        (trajectory_row("a-1", "task_000", True), encode_recording(recording(6))),
        (trajectory_row("a-1", "task_001", True), encode_recording(slow)),
    ]
    source = write_recorded_dataset(tmp_path / "out", {"a-1": rows})
    with pytest.raises(InputError) as refused:
        export_lerobot(open_dataset(source), tmp_path / "made", LeRobotOptions(width=32, height=24))
    assert refused.value.reason == "mixed_episodes"


def test_the_camera_of_a_scene_that_has_none_is_said(tmp_path):
    source = two_scenes(tmp_path / "out", photographed=False)
    with pytest.raises(InputError) as refused:
        export_lerobot(
            open_dataset(source), tmp_path / "made", LeRobotOptions(width=32, height=24, pictures=("scene",))
        )
    assert refused.value.reason == "no_camera"


def test_a_dataset_without_trajectories_says_so(tmp_path):
    source = write_recorded_dataset(tmp_path / "out", {"a-1": []})
    with pytest.raises(InputError, match="it has no trajectories"):
        export_lerobot(open_dataset(source), tmp_path / "made", LeRobotOptions())
    failures = [(trajectory_row("a-1", "task_000", False), encode_recording(recording(6)))]
    source = write_recorded_dataset(tmp_path / "lost", {"a-1": failures})
    with pytest.raises(InputError, match="1 of its trajectories failed; --failed"):
        export_lerobot(open_dataset(source), tmp_path / "made", LeRobotOptions())
