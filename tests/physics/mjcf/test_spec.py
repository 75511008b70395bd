"""MJCF: pose in is pose out, mass and inertia as given, loads from memory and from a folder."""

import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.geometry import Camera, Pose, TriangleMesh
from schemas.identity import find_name_clashes
from tableverse_factory.geometry.math.camera import PosedCamera, project
from tableverse_factory.geometry.math.transforms import (
    identity_pose,
    normalize_quaternion,
    rotation_angle,
    rotation_matrix,
    transform_points,
)
from tableverse_factory.physics.mjcf.slab import OBJECT_MARGIN_M, fit_slab
from tableverse_factory.physics.mjcf.spec import SceneBody, make_scene_body, make_scene_files
from tableverse_factory.physics.simulate.at_rest import find_free_bodies, read_body_poses
from tests.helpers.simple_scenes import TABLE, ball, box, cylinder

SLAB = fit_slab(TABLE, [], [], [])
POSES = st.builds(
    lambda p, q: Pose(np.array(p), normalize_quaternion(np.array(q))),
    st.tuples(*[st.floats(-20.0, 20.0)] * 3),
    st.tuples(*[st.floats(-1.0, 1.0)] * 4).filter(lambda q: np.linalg.norm(q) > 0.1),
)


def body_of(mesh: TriangleMesh, pose: Pose, object_id: str = "obj_000", mass: float = 0.3) -> SceneBody:
    return make_scene_body(object_id, mesh, (mesh,), 1.0, mass, pose)


@pytest.mark.heavy
@settings(max_examples=25, deadline=None)
@given(POSES)
def test_pose_in_is_pose_out(pose: Pose) -> None:
    model = make_scene_files([body_of(box(0.1, 0.06, 0.03), pose)], SLAB).model()
    (found,) = read_body_poses(model, mujoco.MjData(model), find_free_bodies(model))
    np.testing.assert_allclose(found.position, pose.position, atol=1e-9)
    assert rotation_angle(found.quaternion_wxyz, pose.quaternion_wxyz) < 1e-9


def test_vertices_stand_where_the_pose_puts_them() -> None:
    lopsided = TriangleMesh(box(0.1, 0.06, 0.03).vertices + np.array([0.5, -0.2, 0.1]), box(1, 1, 1).faces)
    pose = Pose(np.array([0.1, 0.2, 0.3]), normalize_quaternion(np.array([0.3, -0.5, 0.2, 0.7])))
    model = make_scene_files([body_of(lopsided, pose)], SLAB).model()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    for geom in np.flatnonzero(model.geom_type == mujoco.mjtGeom.mjGEOM_MESH):
        mesh = int(model.geom_dataid[geom])
        first = int(model.mesh_vertadr[mesh])
        local = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]
        world = local @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom]
        expected = transform_points(pose, lopsided.vertices)
        order, wanted = np.lexsort(world.round(5).T), np.lexsort(expected.round(5).T)
        np.testing.assert_allclose(world[order], expected[wanted], atol=1e-6)


def test_mass_centre_and_inertia_are_those_of_the_mesh() -> None:
    mesh = cylinder(0.04, 0.1, sections=30)
    two_pieces = (mesh, mesh)  # overlapping pieces must not count twice
    body = make_scene_body("obj_000", mesh, two_pieces, 1.0, 0.37, identity_pose())
    model = make_scene_files([body], SLAB).model()
    at = model.body("obj_000")
    assert at.mass[0] == pytest.approx(0.37, rel=1e-9)
    np.testing.assert_allclose(np.sort(at.inertia), np.linalg.eigvalsh(body.properties.inertia), rtol=1e-6)


def test_scale_is_in_the_files() -> None:
    body = make_scene_body("obj_000", box(1.0, 1.0, 1.0), (box(1.0, 1.0, 1.0),), 0.1, 1.0, identity_pose())
    model = make_scene_files([body], SLAB).model()
    assert np.abs(model.mesh_vert).max() == pytest.approx(0.05, rel=1e-6)
    np.testing.assert_allclose(model.body("obj_000").inertia, 0.01 / 6, rtol=1e-6)


def test_groups_classes_and_settings_are_in_the_xml() -> None:
    files = make_scene_files([body_of(ball(0.03), identity_pose())], SLAB, timestep_s=0.001)
    model = files.model()
    visual, piece, table = model.geom("obj_000"), model.geom("obj_000_piece_00"), model.geom("table")
    assert (visual.group[0], visual.contype[0], visual.conaffinity[0]) == (2, 0, 0)
    assert (piece.group[0], piece.contype[0], piece.condim[0]) == (3, 1, 6)
    assert model.geom_bodyid[table.id] == model.body("table").id
    assert model.body("table").jntnum[0] == 0
    assert 'class="visual"' in files.xml
    assert 'class="collision"' in files.xml
    assert model.opt.timestep == 0.001
    assert model.opt.integrator == mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    assert model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    assert (model.opt.impratio, model.opt.noslip_iterations) == (100.0, 5)
    np.testing.assert_allclose(piece.friction, [0.8, 0.01, 0.01])


def test_the_files_that_the_xml_names_are_the_assets() -> None:
    files = make_scene_files([body_of(ball(0.03), identity_pose())], SLAB)
    root = ET.fromstring(files.xml)
    folder = root.find("compiler").get("meshdir")
    assert {f"{folder}/{mesh.get('file')}" for mesh in root.iter("mesh")} == files.assets.keys()


def test_words_that_older_mujoco_does_not_know_are_not_written() -> None:
    xml = make_scene_files([body_of(ball(0.03), identity_pose())], SLAB).xml
    assert "colorspace" not in xml
    assert "directional" not in xml
    assert "shell" not in xml
    assert '<flag multiccd="enable" />' in xml
    assert 'solref="0.004 1"' in xml, "Newton takes an omitted damping ratio for 0"


def test_loads_from_an_extracted_folder_as_from_memory(tmp_path: Path) -> None:
    files = make_scene_files([body_of(ball(0.03), identity_pose())], SLAB)
    (tmp_path / "assets").mkdir()
    (tmp_path / "scene.xml").write_text(files.xml)
    for name, data in files.assets.items():
        (tmp_path / name).write_bytes(data)
    from_folder = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    np.testing.assert_array_equal(from_folder.mesh_vert, files.model().mesh_vert)


def test_equal_scenes_give_equal_bytes() -> None:
    def again() -> tuple[str, dict[str, bytes]]:
        files = make_scene_files(
            [body_of(ball(0.03), identity_pose()), body_of(box(1, 1, 1), identity_pose(), "b")], SLAB
        )
        return files.xml, files.assets

    assert again() == again()


def test_an_open_mesh_and_a_sliver_load() -> None:
    whole = box(0.1, 0.1, 0.1)
    sheet = TriangleMesh(whole.vertices, whole.faces[:3])
    body = make_scene_body("obj_000", sheet, (whole, box(0.1, 0.1, 1e-5)), 1.0, 0.1, identity_pose())
    assert body.dropped_pieces == 1
    assert make_scene_files([body], SLAB).model().ngeom == 3


@pytest.mark.parametrize(
    ("ids", "bad"),
    [
        (["obj_000", "obj_001"], []),
        (["table", "world", "mug"], ["table", "world"]),
        (["mug", "mug_piece_00"], ["mug_piece_00"]),
        (["Mug", "mug"], ["mug"]),
        (["sky", "Scene", "Table", "backdrop"], ["sky", "Scene", "Table", "backdrop"]),
    ],
)
def test_ids_that_cannot_share_a_scene(ids: list[str], bad: list[str]) -> None:
    assert find_name_clashes(ids) == bad


def test_the_longest_id_still_fits_a_tar() -> None:
    long_id = "a" * 96
    files = make_scene_files([body_of(ball(0.03), identity_pose(), long_id)], SLAB)
    assert files.model().body(long_id).mass[0] > 0
    assert max(len(name) for name in files.assets) <= 100


def test_the_pictures_camera_sees_what_the_picture_saw() -> None:
    camera = Camera(600.0, 620.0, 300.5, 251.0, 640, 480)
    # In the table frame: half a metre up, looking straight down, x of the picture along x of the table.
    looking_down = Pose(np.array([0.0, 0.0, 0.5]), np.array([0.0, 1.0, 0.0, 0.0]))
    files = make_scene_files([body_of(ball(0.03), identity_pose())], SLAB, view=PosedCamera(camera, looking_down))
    model = files.model()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.cam_xmat[0].reshape(3, 3), np.eye(3), atol=1e-9)  # MuJoCo's cameras look along -z
    drawn, eye = mujoco.MjvScene(model, 100), mujoco.MjvCamera()
    eye.type, eye.fixedcamid = mujoco.mjtCamera.mjCAMERA_FIXED, 0
    mujoco.mjv_updateScene(model, data, mujoco.MjvOption(), None, eye, mujoco.mjtCatBit.mjCAT_ALL, drawn)
    lens = drawn.camera[0]
    point = np.array([[0.11, -0.07, 0.4]])  # before the camera [m]
    x, y = point[0, :2] / point[0, 2] * lens.frustum_near
    u = 320 * (1 + (x - lens.frustum_center) / lens.frustum_width) - 0.5
    v = 480 * (lens.frustum_top + y) / (lens.frustum_top - lens.frustum_bottom) - 0.5
    np.testing.assert_allclose([[u, v]], project(point, camera), atol=1e-2)


@given(st.floats(-0.7, 0.7), st.floats(-1.0, 1.0), st.floats(-1.0, 1.0))
def test_the_slab_reaches_beyond_every_object(yaw: float, x: float, y: float) -> None:
    from dataclasses import replace

    slab = fit_slab(
        replace(TABLE, yaw=yaw), [box(0.1, 0.1, 0.1)], [Pose(np.array([x, y, 0.05]), np.array([1.0, 0, 0, 0]))], [1.0]
    )
    away = OBJECT_MARGIN_M + 0.05
    axes = rotation_matrix(np.array([np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]))[:2, :2]
    around = np.array([[x, y]]) + np.array([[away, 0], [-away, 0], [0, away], [0, -away]]) @ axes.T * 0.999
    assert slab.holds(np.column_stack([around, np.zeros(4)])).all()
    corners = np.array([[0.3, 0.2], [-0.3, 0.2], [0.3, -0.2], [-0.3, -0.2]]) @ axes.T * 0.999
    assert slab.holds(np.column_stack([corners, np.zeros(4)])).all()
