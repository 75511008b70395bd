"""What is shown, without a browser: poses, pieces, contacts, physics, the camera, the clock, the list, the texts."""

import io
import json
import struct

import mujoco
import numpy as np
import pytest
import trimesh

from schemas.geometry import Pose
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.viz.viewer.glb import choose_piece_color
from tableverse_factory.viz.viewer.loaded_scene import LoadedScene, load_scene_file, merge_poses
from tableverse_factory.viz.viewer.motion_playback import MotionPlayback, describe_outcome
from tableverse_factory.viz.viewer.motion_player import Playhead
from tableverse_factory.viz.viewer.origin_check import OriginPolicy
from tableverse_factory.viz.viewer.panel_html import escape_text, format_dropped_scene, format_facts
from tableverse_factory.viz.viewer.scene_cache import MAX_SCENES, SceneCache
from tableverse_factory.viz.viewer.scene_index import SceneIndex
from tableverse_factory.viz.viewer.simulation import Simulation
from tests.helpers.recorded_dataset import CAMERA, EYE, X_ID, Y_ID, recording
from tests.helpers.viewer_dataset import ABOVE_M, ASIDE_M, HOSTILE, many_scenes, members, opened, scene_of


@pytest.fixture(scope="module")
def scene() -> LoadedScene:
    return LoadedScene(scene_of())


def loaded(glb: bytes) -> trimesh.Trimesh:
    (mesh,) = trimesh.load(io.BytesIO(glb), file_type="glb").geometry.values()
    return mesh


# What is drawn


def test_every_layout_has_every_object_where_the_pipeline_had_it(scene):
    settled = scene.settled[X_ID].position
    assert list(scene.layouts) == ["observed", "rectified", "settled"]
    np.testing.assert_allclose(scene.layouts["observed"][X_ID].position - settled, [ASIDE_M, 0, 0], atol=1e-9)
    np.testing.assert_allclose(
        scene.layouts["rectified"][Y_ID].position - scene.settled[Y_ID].position, [0, 0, ABOVE_M]
    )


def test_a_copy_was_not_observed():
    files = members("a-1")
    meta = json.loads(files["meta.json"])
    meta["objects"][1]["poses"]["placed"] = None
    assert (
        X_ID not in LoadedScene(Scene("a-1", {}, {**files, "meta.json": json.dumps(meta).encode()})).layouts["observed"]
    )


@pytest.mark.parametrize("position", [[0, 0], [0, 0, "x"], [float("nan"), 0, 0], [1e9, 0, 0], "abc", None])
def test_poses_that_are_none_are_refused(position):
    files = members("a-1")
    meta = json.loads(files["meta.json"])
    meta["objects"][0]["poses"]["rectified"]["position"] = position
    with pytest.raises(InputError, match="pose"):
        LoadedScene(Scene("a-1", {}, {**files, "meta.json": json.dumps(meta).encode()}))


def test_what_is_sent_is_the_object_in_its_own_frame_with_its_texture(scene):
    mesh = loaded(scene.bodies[1].look)
    np.testing.assert_allclose(mesh.extents, (0.04, 0.04, 0.12), atol=1e-5)
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), 0.0, atol=1e-5)
    assert mesh.volume > 0  # faces look outwards, or the browser would not draw them
    assert mesh.visual.material.baseColorTexture is not None
    flat = np.abs(mesh.vertex_normals).max(axis=1)
    np.testing.assert_allclose(flat, 1.0, atol=1e-4)  # the edges of a box stay sharp


def test_the_table_lies_below_the_objects(scene):
    ((glb, pose),) = scene.static
    top = transform_points(pose, loaded(glb).vertices)[:, 2].max()
    assert top == pytest.approx(0.0, abs=1e-6)


def test_another_texture_changes_the_table_and_nothing_else(scene):
    ((before, pose),), ((after, same),) = scene.static, scene.retexture_table("marble-3")
    assert before != after
    np.testing.assert_array_equal(pose.position, same.position)
    assert scene.retexture_table(None) == scene.static
    with pytest.raises(InputError, match="no texture"):
        scene.retexture_table("nothing-3")


def test_pieces_differ_in_colour(scene):
    assert len({choose_piece_color(number) for number in range(48)}) == 48
    assert scene.bodies[0].n_pieces == 1
    first, second = (np.unique(loaded(each.pieces).visual.vertex_colors, axis=0) for each in scene.bodies)
    assert len(first) == 1
    assert (first != second).any()


def test_a_model_that_is_none_of_ours_is_refused(tmp_path):
    xml = '<mujoco><worldbody><body><joint type="hinge"/><geom size=".1"/></body></worldbody></mujoco>'
    with pytest.raises(InputError, match="joints besides free ones"):
        LoadedScene(Scene("a", {}, {"scene.xml": xml.encode()}))


# Camera


def test_the_camera_starts_where_the_picture_was_taken_and_sees_all_of_it(scene):
    view = scene.viewpoint
    assert scene.has_camera
    np.testing.assert_allclose(view.position, EYE.position)
    middle = transform_points(invert_pose(EYE), view.target[None])[0]
    np.testing.assert_allclose(middle[:2], 0.0, atol=1e-9)  # on the optical axis
    assert view.target[2] == pytest.approx(0.0, abs=1e-9)  # and on the table
    upright = 2 * np.arctan(CAMERA.height / 2 / CAMERA.fy)
    assert view.field_of_view(CAMERA.width / CAMERA.height) == pytest.approx(upright)
    assert view.field_of_view(3.0) == pytest.approx(upright)
    narrow = view.field_of_view(0.5)
    assert 0.5 * np.tan(narrow / 2) == pytest.approx(CAMERA.width / 2 / CAMERA.fx)


def test_without_a_camera_it_looks_from_the_front_and_above():
    scene = LoadedScene(scene_of(photographed=False))
    assert not scene.has_camera
    assert scene.photograph is None
    assert scene.viewpoint.position[1] < 0 < scene.viewpoint.position[2]


# Physics


def test_what_stands_stays_and_presses_with_its_weight(scene):
    simulation = Simulation(scene.model)
    simulation.advance(1.0)
    for name, pose in simulation.poses().items():
        np.testing.assert_allclose(pose.position, scene.settled[name].position, atol=1e-3)
    contacts = simulation.contacts()
    weight = sum(figure.mass_kg for figure in scene.bodies) * 9.81
    assert contacts.forces_n.sum() == pytest.approx(weight, rel=0.02)
    assert np.abs(contacts.points[:, 2]).max() < 1e-3
    np.testing.assert_allclose(np.abs(contacts.normals[:, 2]), 1.0, atol=1e-6)
    assert (np.diff(contacts.forces_n) <= 0).all()


def test_contacts_are_those_of_mujoco_and_of_what_is_shown(scene):
    data = mujoco.MjData(scene.model)
    mujoco.mj_step(scene.model, data, 500)
    mujoco.mj_forward(scene.model, data)
    simulation, held = Simulation(scene.model), Simulation(scene.model)
    simulation.advance(500 * scene.model.opt.timestep)
    held.reset(simulation.poses())
    assert held.contacts().total == data.ncon > 0
    shown = held.contacts(shown={Y_ID})
    assert 0 < shown.total < data.ncon
    assert shown.forces_n.sum() == pytest.approx(scene.bodies[0].mass_kg * 9.81, rel=0.02)


def test_from_a_layout_things_fall_and_the_model_is_shared(scene):
    before = scene.model.qpos0.copy()
    simulation, other = Simulation(scene.model), Simulation(scene.model)
    simulation.reset(scene.layouts["rectified"])
    assert len(simulation.contacts()) == 0
    passed = simulation.advance(0.05)
    assert passed == pytest.approx(0.05)
    fallen = scene.layouts["rectified"][X_ID].position[2] - simulation.poses()[X_ID].position[2]
    assert fallen == pytest.approx(0.5 * 9.81 * 0.05**2, rel=0.1)
    np.testing.assert_array_equal(scene.model.qpos0, before)
    np.testing.assert_allclose(other.poses()[X_ID].position, scene.settled[X_ID].position, atol=1e-9)


def test_a_push_changes_the_speed_by_impulse_over_mass(scene):
    simulation, mass = Simulation(scene.model), scene.bodies[1].mass_kg
    simulation.push(X_ID, mass * np.array([0.0, 0.0, 1.0]))
    simulation.push("nobody", np.ones(3))
    simulation.advance(0.1)
    risen = simulation.poses()[X_ID].position[2] - scene.settled[X_ID].position[2]
    assert risen == pytest.approx(0.1 - 0.5 * 9.81 * 0.1**2, rel=0.05)


def test_a_spent_budget_ends_the_steps(scene):
    assert Simulation(scene.model).advance(1.0, budget_s=0.0) == 0.0


# Motions


def test_a_motion_is_where_its_recording_says():
    record = recording(pushed=True)
    motion = MotionPlayback(record, X_ID)
    assert motion.duration_s == pytest.approx(2.0)
    sample = motion.sample_at(1.0)
    assert sample == 20
    assert (motion.sample_at(-5.0), motion.sample_at(1e9)) == (0, len(record) - 1)
    poses = motion.object_poses(sample)
    np.testing.assert_allclose(poses[X_ID].position, record.object_pose[sample, :3])
    np.testing.assert_allclose(poses[Y_ID].position, record.moved_poses[sample, 0, :3])
    assert len(motion.arm_poses(sample)) == len(motion.meshes)
    assert np.abs(motion.arm_poses(0)[-1].position - motion.arm_poses(40)[-1].position).max() > 0.05
    base = {X_ID: Pose(np.zeros(3), np.array([1.0, 0, 0, 0]))}
    assert list(merge_poses(base, poses)) == [X_ID]  # what the scene lacks is not drawn


def test_how_a_task_ended_is_told_in_a_line():
    failed = {"success": False, "failed_phase": "pre_place", "reason": "not_grasped", "detail": "\x1b[2Jbad\nline"}
    assert describe_outcome({"success": True}) == "success"
    assert describe_outcome(failed) == r"failed in pre-place: not grasped (\x1b[2Jbad\nline)"
    assert describe_outcome({**failed, "failed_phase": None, "detail": None}) == "failed: not grasped"


def test_the_playhead_stops_at_the_end_and_starts_again():
    head = Playhead(2.0)
    head.advance(1.0)
    assert head.time_s == 0.0
    head.play()
    head.advance(1.5)
    head.advance(1.5)
    assert (head.time_s, head.playing) == (2.0, False)
    head.play()
    assert (head.time_s, head.playing) == (0.0, True)
    head.seek(-1.0)
    assert head.time_s == 0.0


# The list


def test_scenes_are_found_by_id_name_label_and_status(tmp_path):
    catalogue = SceneIndex(opened(tmp_path / "out"))
    assert len(catalogue) == 3
    assert catalogue.search("RED block").scene_ids == ["a-1", "b-2"]
    assert catalogue.search("red", "dropped").scene_ids == []
    assert catalogue.search(status="dropped").scene_ids == ["c-3"]
    assert catalogue.search("c-3 nothing").scene_ids == []
    assert catalogue.search("%.*[(").scene_ids == []
    assert catalogue.first() == "a-1"


def test_a_list_of_twenty_thousand_is_looked_at_in_windows(tmp_path):
    found = SceneIndex(opened_many := _many(tmp_path)).search("mug k99 s-01")
    assert len(opened_many.shards) == 1
    assert len(found) == 100
    assert found.page("s-010099", 50) == list(found.scene_ids[:50])
    assert found.page("s-019999", 50) == list(found.scene_ids[50:])
    assert found.step_from("s-010099", -1) == "s-010099"
    assert found.step_from("s-010099", 1) == "s-010199"
    assert found.step_from("s-010099", 50) == found.scene_ids[50]
    assert found.step_from("gone", 1) == "s-010099"


def _many(tmp_path):
    from tableverse_factory.dataset.dataset import open_dataset

    return open_dataset(many_scenes(tmp_path / "many", 20_000))


@pytest.mark.heavy
def test_few_opened_scenes_are_kept(tmp_path):
    ids = [f"s-{number}" for number in range(MAX_SCENES + 1)]
    shelf = SceneCache(opened(tmp_path / "out", ids))
    first, second = shelf.open(ids[0]), shelf.open(ids[1])
    assert shelf.open(ids[0]) is first
    for scene_id in ids[2:]:
        shelf.open(scene_id)
    assert shelf.open(ids[0]) is first  # asked for after the second
    assert shelf.open(ids[1]) is not second


def test_a_lost_scene_says_why_and_an_unknown_one_is_told(tmp_path):
    shelf = SceneCache(opened(tmp_path / "out"))
    assert shelf.find_dropped_row("c-3")["reason"] == "not_at_rest"
    assert shelf.find_dropped_row("a-1") is None
    with pytest.raises(InputError, match="no scene 'nope'"):
        shelf.open("nope")


def test_a_scene_that_lies_in_a_folder_opens_too(tmp_path):
    folder = tmp_path / "scene"
    scene_of().extract(folder)
    shelf = SceneCache(load_scene_file(folder / "scene.xml"))
    scene = shelf.open(shelf.first())
    assert (len(shelf), scene.scene.scene_id, scene.has_camera) == (1, "scene", True)
    assert scene.photograph is not None
    assert list(scene.layouts) == ["observed", "rectified", "settled"]
    assert shelf.search("", "any").scene_ids == ["scene"]
    assert {row["object_id"] for row in scene.object_rows} == {X_ID, Y_ID}
    assert not scene.scene.task_rows()
    with pytest.raises(InputError, match="no such file"):
        load_scene_file(folder / "none.xml")


# Texts


def test_foreign_text_stays_text():
    row = {"source": HOSTILE, "licence": HOSTILE, "quality_score": HOSTILE}
    objects = [{"object_id": "obj_000", "label": HOSTILE, "mass_kg": "much"}]
    tasks = [{"instruction": HOSTILE, "accepted": True}]
    html = format_facts(
        row,
        {"certificate": {"drift_m": HOSTILE}},
        objects,
        tasks,
        OriginPolicy("::1").make_link(HOSTILE, None, HOSTILE),
    )
    html += format_dropped_scene({"status": HOSTILE, "stage": HOSTILE, "reason": HOSTILE, "detail": HOSTILE})
    assert "<script" not in html
    assert "<img" not in html
    assert len(escape_text("x" * 10_000)) == 120


def test_the_panel_tells_where_metres_come_from():
    row = {"scale_source": "measured", "scale_sigma": 0.0132, "intrinsics_source": "exif", "field_of_view_deg": 56.1}
    html = format_facts(row, {}, [], [], "")
    assert "measured by a known length, ±1.3 %<" in html
    assert "from EXIF, 56°<" in html
    near, far = (format_facts({**row, "scale_deviation": value}, {}, [], [], "") for value in (-2.7, 3.4))
    assert "±1.3 %, 2.7 standard deviations smaller than estimated<" in near
    assert "±1.3 %, 3.4 standard deviations larger than estimated: check the known length<" in far
    odd = {"scale_source": HOSTILE, "scale_sigma": HOSTILE, "scale_deviation": HOSTILE}
    odd |= {"intrinsics_source": HOSTILE, "field_of_view_deg": HOSTILE}
    assert "camera" not in format_facts(odd, {}, [], [], "")


def test_long_lists_are_cut():
    objects = [{"object_id": f"obj_{number:03d}", "label": "mug"} for number in range(5000)]
    html = format_facts({}, {}, objects, [], "")
    assert html.count("<tr>") == 100
    assert "Objects (5000)" in html


def test_the_glb_is_one_file_that_needs_no_other(scene):
    data = scene.bodies[0].look
    size = struct.unpack("<I", data[12:16])[0]
    content = json.loads(data[20 : 20 + size])
    assert all("uri" not in each for each in (*content["buffers"], *content["images"]))
