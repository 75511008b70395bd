"""Films show what was recorded: the arm where it was, the object where it was, at the right times."""

import io
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from schemas.geometry import Camera, Pose
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Scene, open_dataset
from tableverse_factory.delivery.episodes.actors import ArmMeshes, build_recorded_scene, iterate_poses
from tableverse_factory.delivery.episodes.cameras import load_scene_camera, place_film_camera, place_robot_camera
from tableverse_factory.delivery.episodes.film import choose_samples, encode_webp, render_frames
from tableverse_factory.delivery.episodes.plot import plot_svg
from tableverse_factory.geometry.math.camera import PosedCamera, project
from tableverse_factory.geometry.math.transforms import compose_poses, invert_pose, quaternion_about_z, transform_points
from tableverse_factory.physics.render.render import look_at
from tableverse_factory.robotics.robots.registry import load_arm
from tests.helpers.recorded_dataset import BASE, EYE, X_ID, Y_ID, recording, scene_members

PHASES = {"pre-grasp", "grasp", "post-grasp", "pre-place", "place", "post-place"}


@pytest.fixture(scope="module")
def figure() -> ArmMeshes:
    return ArmMeshes(load_arm("panda"))


def test_the_fingers_of_the_figure_are_at_the_recorded_tcp(out, figure):
    """Nothing of the arm is nearer to the recorded point between the fingertips than the fingers, on both sides."""
    taken = recording()
    cast = build_recorded_scene(open_dataset(out).scene("a-1"), X_ID, figure, taken)
    for sample, poses in zip((0, 20, 40), iterate_poses(cast, figure, taken, (0, 20, 40)), strict=True):
        meshes = zip(cast.moving.meshes[len(cast.names) :], poses[len(cast.names) :], strict=True)
        points = np.concatenate([transform_points(pose, mesh.vertices) for mesh, pose in meshes])
        away = np.sort(np.linalg.norm(points - taken.tcp[sample, :3], axis=1))
        assert away[0] < 0.06
        assert np.linalg.norm(points - BASE.position, axis=1).min() < 0.15


def test_the_carried_object_is_drawn_where_it_was(out, figure):
    taken, scene = recording(), open_dataset(out).scene("a-1")
    eye = place_robot_camera(taken.base, 160, 120)
    samples = [0, 20, 40]
    for sample, picture in zip(samples, render_frames(scene, X_ID, taken, figure, eye, samples), strict=True):
        middle = taken.object_pose[sample, :3].astype(np.float64)[None]
        x, y = np.rint(project(transform_points(invert_pose(eye.camera_to_table), middle), eye.camera)[0]).astype(int)
        if 0 <= x < 160 and 0 <= y < 120:
            red, green, _ = picture[y, x].astype(int)
            assert green > red + 40


def test_what_was_pushed_is_drawn_where_it_was(out, figure):
    """Nothing red is left where the reference stood, and red is where it went."""
    scene, taken = open_dataset(out).scene("a-1"), recording(pushed=True)
    cast = build_recorded_scene(scene, X_ID, figure, taken)
    assert cast.names == (Y_ID, X_ID)
    poses = list(iterate_poses(cast, figure, taken, (0, 40)))
    assert poses[0][0].position == pytest.approx([0.0, 0.0, 0.03], abs=1e-6)
    assert poses[1][0].position == pytest.approx([-0.06, 0.0, 0.03], abs=1e-6)
    for pose, mesh in zip(poses[0], cast.moving.meshes[:2], strict=False):
        assert transform_points(pose, mesh.vertices).mean(axis=0)[2] == pytest.approx(pose.position[2], abs=1e-3)
    eye = look_at(np.array([0.0, -0.5, 0.6]), np.array([0.0, 0.0, 0.0]))
    camera = Camera(150.0, 150.0, 79.5, 59.5, 160, 120)
    top = np.array([[-0.095, 0.0, 0.06], [0.045, 0.0, 0.06]])
    at = np.rint(project(transform_points(invert_pose(eye), top), camera)).astype(int)
    for picture, red in zip(
        render_frames(scene, X_ID, taken, figure, PosedCamera(camera, eye), (0, 40)), ((0, 1), (1, 0)), strict=True
    ):
        found = [int(picture[y, x, 0]) > int(picture[y, x, 1]) + 40 for x, y in at]
        assert found == [bool(value) for value in red]


def test_what_was_recorded_of_no_object_is_said(figure):
    taken = recording(pushed=True)
    scene = Scene("scene", {}, scene_members("scene"))
    with pytest.raises(InputError, match="no object 'obj_009' to move"):
        build_recorded_scene(scene, X_ID, figure, replace(taken, moved_ids=("obj_009",)))


def test_an_object_that_is_not_there_and_another_arm_are_said(out, figure):
    scene, taken = open_dataset(out).scene("a-1"), recording()
    with pytest.raises(InputError, match="no object"):
        build_recorded_scene(scene, "obj_777", figure, taken)
    other = replace(taken, qpos=taken.qpos[:, :8], qvel=taken.qvel[:, :8])
    with pytest.raises(InputError, match="8 positions are recorded"):
        list(render_frames(scene, X_ID, other, figure, place_robot_camera(BASE, 32, 24), [0]))


def test_samples_begin_and_end_with_the_recording():
    taken = recording(41)
    assert choose_samples(taken, 10.0) == list(range(0, 41, 2))
    assert choose_samples(taken, 1000.0) == list(range(41))
    assert choose_samples(taken, 0.1) == [0, 40]
    assert choose_samples(recording(2), 10.0) == [0, 1]


@pytest.mark.parametrize(("samples", "swing"), [(41, 0.9), (31, -0.5)])
def test_the_camera_of_a_film_sees_the_whole_arm_and_the_whole_way(figure, samples, swing):
    taken = recording(samples, swing=swing)
    eye = place_film_camera(taken, figure, 320, 240)
    points = [taken.tcp[:, :3].astype(np.float64), taken.object_pose[:, :3].astype(np.float64)]
    for positions in taken.qpos.astype(np.float64):
        parts = zip(figure.poses(positions, taken.base), figure.meshes, strict=True)
        points += [transform_points(pose, mesh.vertices) for pose, mesh in parts]
    seen = transform_points(invert_pose(eye.camera_to_table), np.concatenate(points))
    pixels = project(seen, eye.camera)
    assert (seen[:, 2] > 0).all()
    assert ((pixels >= 0) & (pixels <= [319, 239])).all()
    assert np.ptp(pixels, axis=0).max() > 160  # and no more than that


@pytest.mark.parametrize("yaw", [0.0, 1.6, -2.5])
def test_a_film_never_mirrors_left_and_right(figure, yaw):
    """Whatever way the robot looks: what lies further right in the table frame is further right in the film."""
    turned = replace(recording(11), base=Pose(BASE.position, quaternion_about_z(yaw)))
    eye = place_film_camera(turned, figure, 320, 240)
    seen = transform_points(invert_pose(eye.camera_to_table), np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]]))
    assert np.diff(project(seen, eye.camera)[:, 0])[0] > 0


@pytest.mark.heavy
@pytest.mark.parametrize("yaw", [-2.5, *(pytest.param(yaw, marks=pytest.mark.slow) for yaw in (0.0, 1.6))])
def test_the_arm_does_not_stand_before_the_object_in_the_end(out, figure, yaw):
    """Beside the robot's line and straight below its hand, the object shows in the last picture."""
    taken, scene = recording(), open_dataset(out).scene("a-1")
    turned = replace(taken, base=Pose(BASE.position, quaternion_about_z(yaw)))
    tip = compose_poses(
        turned.base,
        compose_poses(invert_pose(taken.base), Pose(taken.tcp[-1, :3].astype(np.float64), BASE.quaternion_wxyz)),
    )
    place = np.array([*tip.position[:2], tip.position[2] - 0.11], dtype=np.float32)
    poses = taken.object_pose.copy()
    poses[:, :3] = place
    ended = replace(turned, object_pose=poses)
    eye = place_film_camera(ended, figure, 320, 240)
    (picture,) = render_frames(scene, X_ID, ended, figure, eye, [len(ended) - 1])
    x, y = np.rint(
        project(transform_points(invert_pose(eye.camera_to_table), place.astype(np.float64)[None]), eye.camera)[0]
    ).astype(int)
    red, green, _ = picture[y, x].astype(int)
    assert green > red + 40


@pytest.mark.heavy
def test_a_robot_on_the_viewers_side_does_not_stand_before_what_it_carries(out, figure):
    """An arm that reaches away from the viewer would hide the object straight below its hand all the way."""
    taken, scene = recording(), open_dataset(out).scene("a-1")
    turned = compose_poses(Pose(np.zeros(3), quaternion_about_z(np.pi / 2)), BASE)
    moved = compose_poses(turned, invert_pose(taken.base))
    poses = taken.object_pose.copy()
    poses[:, :3] = transform_points(moved, taken.tcp[:, :3].astype(np.float64)) - [0.0, 0.0, 0.11]
    carried = replace(taken, base=turned, object_pose=poses)
    eye = place_film_camera(carried, figure, 320, 240)
    samples = [0, 10, 20, 30, 40]
    for sample, picture in zip(samples, render_frames(scene, X_ID, carried, figure, eye, samples), strict=True):
        seen = transform_points(invert_pose(eye.camera_to_table), poses[sample, :3].astype(np.float64)[None])
        x, y = np.rint(project(seen, eye.camera)[0]).astype(int)
        red, green, _ = picture[y, x].astype(int)
        assert green > red + 40


def test_the_scenes_own_camera_keeps_its_middle_in_any_format():
    """What its optical axis hits stays in the middle of a picture of another shape."""
    keys = {"fx": 300.0, "fy": 300.0, "cx": 159.5, "cy": 119.5, "width": 320, "height": 240}
    pose = {"position": EYE.position.tolist(), "quaternion_wxyz": EYE.quaternion_wxyz.tolist()}
    for width, height in ((320, 240), (160, 120), (128, 128), (64, 200)):
        camera = load_scene_camera({"camera": keys, "camera_to_table": pose}, width, height).camera
        assert (camera.cx, camera.cy) == pytest.approx(((width - 1) / 2, (height - 1) / 2))
        assert camera.fx == camera.fy >= 300.0 * max(width / 320, height / 240) - 1e-9
    same = load_scene_camera({"camera": keys, "camera_to_table": pose}, 320, 240).camera
    assert same == Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
    assert load_scene_camera({"camera": None, "camera_to_table": None}, 320, 240) is None


@pytest.mark.parametrize("change", [{"fx": "a"}, {"width": 0}, {"fx": float("nan")}, {"fy": -1.0}])
def test_a_camera_that_makes_no_sense_is_said(change):
    keys = {"fx": 300.0, "fy": 300.0, "cx": 159.5, "cy": 119.5, "width": 320, "height": 240, **change}
    pose = {"position": [0, 0, 1], "quaternion_wxyz": [1, 0, 0, 0]}
    with pytest.raises(InputError, match="invalid camera"):
        load_scene_camera({"camera": keys, "camera_to_table": pose}, 320, 240)


def test_a_film_is_a_webp_of_all_its_frames():
    pictures = [np.full((24, 32, 3), 40 * k, dtype=np.uint8) for k in range(5)]
    data = encode_webp(pictures, 10.0)
    assert data == encode_webp(pictures, 10.0)
    with Image.open(io.BytesIO(data)) as film:
        assert (film.n_frames, film.size) == (5, (32, 24))
        film.seek(3)
        assert abs(int(np.asarray(film.convert("RGB")).mean()) - 120) < 5


def plotted(taken) -> ElementTree.Element:
    arm = load_arm("panda")
    text = plot_svg(taken, arm.finger_closed, arm.finger_open, arm.max_opening_m)
    assert "style" not in text
    assert len(text) < 20_000
    return ElementTree.fromstring(text)


def test_the_plot_is_drawn_within_its_frame_and_names_phases_and_lines():
    svg = plotted(recording())
    width, height = (float(value) for value in svg.attrib["viewBox"].split()[2:])
    lines = [line for line in svg.iter() if line.tag.endswith("polyline")]
    assert [line.attrib["class"] for line in lines] == [*(f"j{k}" for k in range(1, 8)), "told", "open"]
    points = np.array([point.split(",") for line in lines for point in line.attrib["points"].split()], dtype=float)
    assert ((points >= 0) & (points <= [width, height])).all()
    assert {e.text for e in svg.iter()} >= PHASES
    explained = {e.attrib["class"].removeprefix("line ") for e in svg.iter() if e.get("class", "").startswith("line ")}
    assert explained == {line.attrib["class"] for line in lines}
    assert {"1", "7", "gripper", "its command"} <= {e.text for e in svg.iter()}


def test_names_of_phases_stand_beside_one_another_however_short_the_phases():
    phase = np.array([0] * 30 + [1, 2, 3, 4] + [5] * 7, dtype=np.int32)
    svg = plotted(replace(recording(41), phase=phase))
    names = [e for e in svg.iter() if e.text in PHASES]
    assert {e.text for e in names} == PHASES
    rows: dict[str, float] = {}
    for e in names:
        half, middle = 2.5 * len(e.text), float(e.attrib["x"])
        assert middle - half >= rows.get(e.attrib["y"], 0.0)
        rows[e.attrib["y"]] = middle + half
    assert max(rows.values()) <= 640
