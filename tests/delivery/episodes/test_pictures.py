"""Pictures of policies: the same in the environment and in exports, with depth and instances that are true."""

import io

import av
import numpy as np
import pytest
from scipy.ndimage import binary_erosion

from schemas.geometry import Pose
from schemas.trajectories import Phase
from tableverse_factory import TableEnv, open_dataset
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.delivery.episodes.actors import ArmMeshes, build_recorded_scene
from tableverse_factory.delivery.episodes.cameras import place_robot_camera, place_wrist_camera
from tableverse_factory.delivery.episodes.pictures import (
    MAX_DEPTH_M,
    PICTURES,
    ROBOT_ID,
    TABLE_ID,
    CameraRig,
    check_pictures,
    take_recorded_pictures,
)
from tableverse_factory.delivery.episodes.selection import Episode, open_episode
from tableverse_factory.delivery.episodes.subtasks import SUBTASKS, estimate_phase
from tableverse_factory.delivery.episodes.video import COLOR, LABELS, METERS, encode_mp4, find_kind
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.robotics.robots.registry import load_arm
from tests.helpers.learnable_dataset import write_learnable_dataset

SIZE = (48, 64)


@pytest.fixture(scope="module")
def episode(tmp_path_factory) -> Episode:
    out = write_learnable_dataset(tmp_path_factory.mktemp("seen") / "out", scenes=1)
    dataset = open_dataset(out)
    return open_episode(dataset, dataset.trajectories.to_table().to_pylist()[0])


@pytest.fixture(scope="module")
def taken(episode):
    return take_recorded_pictures(PICTURES[:6], episode, load_arm("panda"), SIZE, [0, 80, 150])


def find_pixel(point, posed):
    seen = transform_points(invert_pose(posed.camera_to_table), np.asarray(point, dtype=np.float64)[None])
    column, row = np.rint(project(seen, posed.camera)[0]).astype(int)
    return row, column, float(seen[0, 2])


@pytest.mark.heavy
def test_an_object_is_where_the_camera_projects_it(episode, taken):
    """Its middle is seen at its own pixel, as its own instance, half of its size nearer than the middle."""
    recording = episode.recording
    eye = place_robot_camera(recording.base, SIZE[1], SIZE[0])
    for k, sample in enumerate((0, 80, 150)):
        row, column, depth = find_pixel(recording.object_pose[sample, :3], eye)
        assert taken["front_instances"][k][row, column, 0] in (1, ROBOT_ID)
        if taken["front_instances"][k][row, column, 0] == 1:
            assert 0.0 < depth - taken["front_depth"][k][row, column, 0] < 0.06
    row, column, _ = find_pixel((0.18, 0.1, 0.035), eye)
    assert taken["front_instances"][0][row, column, 0] == 2, "the reference is the second row of the states"


@pytest.mark.heavy
def test_depth_of_the_table_is_that_of_its_plane(episode, taken):
    recording = episode.recording
    for name, eye in (
        ("front", place_robot_camera(recording.base, SIZE[1], SIZE[0])),
        ("wrist", place_wrist_camera(load_arm("panda"), pose_of(recording.tcp[80]), SIZE[1], SIZE[0])),
    ):
        ids, depth = taken[f"{name}_instances"][1][..., 0], taken[f"{name}_depth"][1][..., 0]
        rows, columns = np.nonzero(binary_erosion(ids == TABLE_ID, np.ones((5, 5))))
        focal, pose = eye.camera.fx, eye.camera_to_table
        rays = np.stack([(columns - eye.camera.cx) / focal, (rows - eye.camera.cy) / focal, np.ones(len(rows))], axis=1)
        points = transform_points(pose, rays * depth[rows, columns, None])
        assert np.abs(points[:, 2]).max() < 1e-3, name


def pose_of(row):
    return Pose(row[:3].astype(np.float64), row[3:].astype(np.float64))


@pytest.mark.heavy
def test_instances_are_those_of_the_scene_and_nothing_has_no_depth(taken):
    for name in ("front", "wrist"):
        seen = np.concatenate([ids.ravel() for ids in taken[f"{name}_instances"]])
        assert set(seen.tolist()) <= {0, 1, 2, 3, TABLE_ID, ROBOT_ID}
        assert {1, TABLE_ID, ROBOT_ID} <= set(seen.tolist())
        for ids, depth in zip(taken[f"{name}_instances"], taken[f"{name}_depth"], strict=True):
            assert ((ids == 0) == (depth == 0)).all()
            assert depth.max() <= MAX_DEPTH_M
    held = taken["wrist_instances"][2][..., 0]
    assert (held == 1).mean() > 0.02, "the wrist sees what the hand holds"


@pytest.mark.heavy
def test_the_environment_shows_what_the_export_holds(episode):
    recording, scene = episode.recording, episode.scene
    env = TableEnv(scene, str(episode.row["task_id"]), pictures=PICTURES[:6], picture_size=SIZE)
    env.reset(seed=0)
    for command in recording.command[1:59]:
        env.sim.step(command)
    observation, _, _, _, info = env.step(env.command_to_action(recording.command[59]))
    exported = take_recorded_pictures(PICTURES[:6], episode, load_arm("panda"), SIZE, [59])
    for name in PICTURES[:6]:
        shown, held = observation[name].astype(float), exported[name][0].astype(float)
        assert shown.shape == held.shape
        assert (np.abs(shown - held) > 2 * (not name.endswith("depth")) + 1e-3).mean() < 0.01, name
    assert info["subtask"] in SUBTASKS.values()


@pytest.mark.heavy
def test_only_what_is_asked_for_is_drawn_and_colours_are_the_same(episode, taken):
    alone = take_recorded_pictures(("wrist",), episode, load_arm("panda"), SIZE, [80])
    assert list(alone) == ["wrist"]
    assert np.array_equal(alone["wrist"][0], taken["wrist"][1])


def test_names_of_pictures_are_checked():
    assert check_pictures(["front", "wrist_depth", "front"]) == ("front", "wrist_depth")
    with pytest.raises(ConfigError, match="no picture 'wrists'; there are front, front_depth"):
        check_pictures(["wrists"])


@pytest.mark.heavy
def test_what_instances_cannot_tell_apart_is_said(episode):
    figure = ArmMeshes(load_arm("panda"))
    cast = build_recorded_scene(episode.scene, str(episode.row["x_id"]), figure, episode.recording)
    base, names = episode.recording.base, [f"obj_{k:03d}" for k in range(254)]
    with pytest.raises(InputError, match="254 objects: instances tell at most 253 apart"):
        CameraRig(("front",), episode.scene, cast, load_arm("panda"), base, names, SIZE)


@pytest.mark.heavy
@pytest.mark.parametrize("kind", [LABELS, METERS])
def test_labels_and_depth_survive_the_video(kind):
    rng = np.random.default_rng(0)
    if kind is METERS:
        pictures = [rng.uniform(0, MAX_DEPTH_M, (*SIZE, 1)).astype(np.float32) for _ in range(5)]
    else:
        pictures = [rng.integers(0, 256, (*SIZE, 1)).astype(np.uint8) for _ in range(5)]
    video = encode_mp4(pictures, 10, kind)
    assert video == encode_mp4(pictures, 10, kind)
    with av.open(io.BytesIO(video)) as file:
        frames = [frame.to_ndarray(format=kind.source) for frame in file.decode(video=0)]
    assert len(frames) == 5
    for picture, frame in zip(pictures, frames, strict=True):
        if kind is METERS:
            assert np.abs(frame / 1000 - picture[..., 0]).max() < 0.00051
        else:
            assert (frame == picture).all()


def test_the_kind_of_a_video_follows_from_the_name():
    kinds = [find_kind(name) for name in PICTURES[:3]]
    assert kinds == [COLOR, METERS, LABELS]


@pytest.mark.parametrize(
    ("state", "phase"),
    [
        ((False, 0, 0.3, 0.0, 0.0, 0.0), Phase.PRE_GRASP),
        ((False, 0, 0.05, 0.0, 0.0, 0.0), Phase.GRASP),
        ((False, 2, 0.01, 0.001, 0.0, 0.0), Phase.GRASP),
        ((False, 2, 0.01, 0.01, 0.0, 0.0), Phase.POST_GRASP),
        ((True, 2, 0.01, 0.1, 0.0, 0.0), Phase.POST_GRASP),
        ((True, 2, 0.01, 0.1, 0.2, 0.3), Phase.PRE_PLACE),
        ((True, 2, 0.01, 0.1, 0.4, 0.01), Phase.PLACE),
        ((True, 0, 0.1, 0.0, 0.4, 0.0), Phase.POST_PLACE),
    ],
)
def test_a_subtask_is_estimated_from_the_state(state, phase):
    assert estimate_phase(*state) is phase


@pytest.mark.heavy
def test_estimated_subtasks_agree_with_the_plan(episode):
    env, words = TableEnv(episode.scene, str(episode.row["task_id"])), list(SUBTASKS.values())
    env.reset(seed=0)
    agree = []
    for command, phase in zip(episode.recording.command[1:], episode.recording.phase[1:], strict=True):
        *_, terminated, _, info = env.step(env.command_to_action(command))
        agree.append(info["subtask"] == words[phase])
        if terminated:
            break
    assert np.mean(agree) > 0.8
