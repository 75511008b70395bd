"""Every format, read back by somebody else's reader: the same shapes at the same places, the same masses, any label."""

import io
import json
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from PIL import Image

from schemas.geometry import Camera, Pose
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.formats.extract import FORMATS, extract_scene, read_labels
from tableverse_factory.delivery.formats.model_contents import read_model_contents
from tableverse_factory.delivery.formats.urdf import compute_roll_pitch_yaw
from tableverse_factory.delivery.formats.usd import encode_usd
from tableverse_factory.evaluation.methods.sources import find_scenes
from tableverse_factory.evaluation.scene_audit import audit_scene
from tableverse_factory.geometry.math.camera import PosedCamera, project
from tableverse_factory.geometry.math.transforms import (
    identity_pose,
    invert_pose,
    pose_from_matrix,
    rotation_matrix,
    transform_points,
)
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.physics.mjcf.slab import fit_slab
from tableverse_factory.physics.mjcf.spec import make_scene_body, make_scene_files
from tests.helpers.exported_scenes import HOSTILE, exported
from tests.helpers.simple_scenes import TABLE, ball

TO_Z_UP = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])


@pytest.fixture(scope="module")
def scene() -> Scene:
    return exported()


@pytest.fixture(scope="module")
def standing(scene: Scene) -> dict[str, np.ndarray]:
    """Corners of every face of every object and the table in the world, z up, from the OBJ files and the XML."""
    model = scene.model()
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    found = {}
    for name in ("obj_000", "obj_001", "obj_002"):
        mesh = trimesh.load(trimesh.util.wrap_as_stream(scene.files()[f"assets/{name}.obj"]), "obj", process=False)
        body = data.body(name)
        world = np.asarray(mesh.vertices) @ body.xmat.reshape(3, 3).T + body.xpos
        found[name] = world[mesh.faces]
    return found


def test_glb_stands_where_the_scene_stands_with_y_up(scene, standing, tmp_path):
    extract_scene(scene, tmp_path / "glb", "glb")
    read = trimesh.load_scene(tmp_path / "glb" / "scene.glb", process=False)
    assert set(read.graph.nodes_geometry) == {*standing, "table"}
    for name, corners in standing.items():
        matrix, geometry = read.graph.get(name)
        mesh = read.geometry[geometry]
        y_up = np.asarray(mesh.vertices) @ matrix[:3, :3].T + matrix[:3, 3]
        assert np.abs((y_up @ TO_Z_UP.T)[mesh.faces] - corners).max() < 1e-6
        assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)
    low, high = read.bounds
    assert high[1] == pytest.approx(max(corners[..., 2].max() for corners in standing.values()), abs=1e-6)
    assert low[1] == pytest.approx(-0.04, abs=1e-6), "the table's board is below the ground plane, along y"


def test_glb_keeps_colours_and_labels(scene, tmp_path):
    extract_scene(scene, tmp_path / "glb", "glb")
    read = trimesh.load_scene(tmp_path / "glb" / "scene.glb", process=False)
    name = read.graph.get("obj_000")[1]
    material = read.geometry[name].visual.material
    red, green, blue = np.asarray(material.baseColorTexture.convert("RGB")).reshape(-1, 3).mean(axis=0)
    assert red > 180
    assert max(green, blue) < 60
    grey = read.geometry[read.graph.get("obj_001")[1]].visual.material.baseColorFactor
    assert len(np.unique(grey)) > 1, "untextured objects keep the colour that the scene gave them"
    labels = {edge[1]: its["metadata"]["label"] for edge, its in _edges(read).items() if "metadata" in its}
    assert labels == {"obj_000": HOSTILE, "obj_001": "can", "obj_002": "cheese"}


def test_glb_has_the_pictures_of_the_scene_pixel_for_pixel(scene, tmp_path):
    extract_scene(scene, tmp_path / "glb", "glb")
    read = trimesh.load_scene(tmp_path / "glb" / "scene.glb", process=False)
    texture = read.geometry[read.graph.get("obj_000")[1]].visual.material.baseColorTexture
    with Image.open(io.BytesIO(scene.files()["assets/obj_000.png"])) as picture:
        assert texture.tobytes() == picture.convert("RGB").tobytes()


def test_glb_shades_round_things_smoothly_and_boxes_sharply(scene, tmp_path):
    extract_scene(scene, tmp_path / "glb", "glb")
    read = trimesh.load_scene(tmp_path / "glb" / "scene.glb", process=False)
    meshes = {name: read.geometry[read.graph.get(name)[1]] for name in ("obj_000", "obj_001")}
    deviations = {}
    for name, mesh in meshes.items():
        normals = np.asarray(mesh.vertex_normals)
        np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-6)
        cosine = np.einsum("fkj,fj->fk", normals[mesh.faces], mesh.face_normals)
        deviations[name] = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))).max()
    assert deviations["obj_000"] < 0.1, "a box"
    assert 2.0 < deviations["obj_001"] < 42.0, "a can: rounded around, sharp at its rims"


def _edges(scene: trimesh.Scene) -> dict:
    return dict(scene.graph.transforms.edge_data)


def test_our_own_reader_takes_the_glb_for_the_same_scene(scene, standing, tmp_path):
    extract_scene(scene, tmp_path / "glb", "glb")
    (source,) = find_scenes(tmp_path / "glb")
    read = source.read()
    assert read.left_out == ("table",)
    for item in read.objects:
        assert np.abs(item.mesh.vertices[item.mesh.faces] - standing[item.name]).max() < 1e-6


def test_plain_extract_is_the_scene_and_a_glb(scene, tmp_path):
    paths = extract_scene(scene, tmp_path / "mjcf")
    names = {path.relative_to(tmp_path / "mjcf").as_posix() for path in paths}
    assert names == {*scene.files(), "scene.glb"}
    assert audit_scene("scene", scene.files()).ok
    mujoco.MjModel.from_xml_path(str(tmp_path / "mjcf" / "scene.xml"))


def test_urdf_loads_in_mujoco_with_masses_inertias_and_places(scene, tmp_path):
    extract_scene(scene, tmp_path / "urdf", "urdf")
    theirs = mujoco.MjModel.from_xml_path(str(tmp_path / "urdf" / "scene.urdf"))
    ours = scene.model()
    free = ("obj_000", "obj_001", "obj_002")
    data, their_data = mujoco.MjData(ours), mujoco.MjData(theirs)
    for model, state in ((ours, data), (theirs, their_data)):
        mujoco.mj_forward(model, state)
    for name in free:
        a, b = data.body(name), their_data.body(name)
        np.testing.assert_allclose(b.xpos, a.xpos, atol=1e-9)
        np.testing.assert_allclose(b.xmat, a.xmat, atol=1e-9)
        np.testing.assert_allclose(b.xipos, a.xipos, atol=1e-9)
        assert theirs.body(name).mass == pytest.approx(ours.body(name).mass, rel=1e-9)
        np.testing.assert_allclose(_world_inertia(theirs, b), _world_inertia(ours, a), rtol=1e-6, atol=1e-12)
    assert sum(theirs.body(name).mass[0] for name in free) == pytest.approx(0.2 * (1 + 1.1 + 1.2))
    assert theirs.nq == ours.nq == 21
    mujoco.mj_step(theirs, their_data, 500)
    assert not sum(warning.number for warning in their_data.warning)
    assert min(their_data.body(name).xpos[2] for name in free) > -0.01, "they rest on the table's collider"


def _world_inertia(model: mujoco.MjModel, body) -> np.ndarray:
    axes = body.ximat.reshape(3, 3)
    return axes @ np.diag(model.body_inertia[body.id]) @ axes.T


def test_urdf_of_one_object_keeps_its_mass_and_meshes(scene, tmp_path):
    extract_scene(scene, tmp_path / "urdf", "urdf")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "urdf" / "obj_001.urdf"))
    assert model.body("obj_001").mass[0] == pytest.approx(0.22)
    root = ET.parse(tmp_path / "urdf" / "obj_000.urdf").getroot()
    (visual,) = root.iter("visual")
    mesh = tmp_path / "urdf" / visual.find("geometry/mesh").get("filename")
    loaded = trimesh.load(mesh, process=False)
    assert loaded.visual.material.image is not None
    assert loaded.volume == pytest.approx(0.1 * 0.08 * 0.04, rel=1e-5)


def test_urdf_has_the_table_its_poses_and_all_frictions(scene, tmp_path):
    extract_scene(scene, tmp_path, "urdf")
    entries = {entry["urdf"]: entry for entry in json.loads((tmp_path / "poses.json").read_text())}
    assert {name: entry["moves"] for name, entry in entries.items()} == {
        "table.urdf": False, "obj_000.urdf": True, "obj_001.urdf": True, "obj_002.urdf": True,
    }  # fmt: skip
    model = scene.model()
    for name, entry in entries.items():
        np.testing.assert_allclose(entry["position"], model.body(name.removesuffix(".urdf")).pos, atol=1e-9)
        x, y, z, w = entry["quaternion_xyzw"]
        np.testing.assert_allclose([w, x, y, z], model.body(name.removesuffix(".urdf")).quat, atol=1e-9)
        contact = ET.parse(tmp_path / name).getroot().find("link/contact")
        frictions = {child.tag: float(child.get("value")) for child in contact}
        geom = model.geom("table" if name == "table.urdf" else f"{name.removesuffix('.urdf')}_piece_00")
        slide, spin, roll = geom.friction
        assert frictions["lateral_friction"] ** 2 == pytest.approx(slide), "Bullet multiplies those of a pair"
        assert (frictions["spinning_friction"], frictions["rolling_friction"]) == pytest.approx((spin, roll))
    box = ET.parse(tmp_path / "table.urdf").getroot().find("link/collision/geometry/box")
    np.testing.assert_allclose([float(side) for side in box.get("size").split()], 2 * model.geom("table").size)


def test_urdf_survives_hostile_labels(scene, tmp_path):
    extract_scene(scene, tmp_path / "urdf", "urdf")
    for path in (tmp_path / "urdf").glob("*.urdf"):
        root = ET.parse(path).getroot()
        labels = {element.get("link"): element.text for element in root.iter("label")}
        assert labels.get("obj_000", HOSTILE) == HOSTILE


@pytest.mark.parametrize("angles", [(0.3, -0.4, 2.0), (0.0, np.pi / 2, 1.0), (3.1, -np.pi / 2, -2.0), (-2.0, 1.2, 3.0)])
def test_roll_pitch_yaw_is_urdf_s_convention(angles):
    rotation = trimesh.transformations.euler_matrix(*angles, axes="sxyz")
    roll, pitch, yaw = compute_roll_pitch_yaw(pose_from_matrix(rotation))
    back = trimesh.transformations.euler_matrix(roll, pitch, yaw, axes="sxyz")
    np.testing.assert_allclose(back, rotation, atol=1e-7)


def test_usd_holds_the_physics(scene, standing, tmp_path):
    pytest.importorskip("pxr", reason="usd-core is an optional extra")
    from pxr import Usd, UsdGeom, UsdPhysics

    extract_scene(scene, tmp_path / "usd", "usd")
    stage = Usd.Stage.Open(str(tmp_path / "usd" / "scene.usd"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    contents = {content.name: content for content in read_model_contents(scene.model()).objects}
    for name, corners in standing.items():
        prim = stage.GetPrimAtPath(f"/World/{name}")
        assert prim.HasAPI(UsdPhysics.RigidBodyAPI)
        mass = UsdPhysics.MassAPI(prim)
        assert mass.GetMassAttr().Get() == pytest.approx(contents[name].mass_kg)
        turn = mass.GetPrincipalAxesAttr().Get()
        axes = rotation_matrix(np.array([turn.GetReal(), *turn.GetImaginary()]))
        inertia = axes @ np.diag(mass.GetDiagonalInertiaAttr().Get()) @ axes.T
        np.testing.assert_allclose(inertia, contents[name].inertia, rtol=1e-5, atol=1e-9)
        look = UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}/look_00"))
        matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(look.GetPrim()))  # rows times matrix
        points = np.array(look.GetPointsAttr().Get()) @ matrix[:3, :3] + matrix[3, :3]
        faces = np.array(look.GetFaceVertexIndicesAttr().Get()).reshape(-1, 3)
        assert np.abs(points[faces] - corners).max() < 1e-6
        pieces = [child for child in prim.GetChildren() if child.HasAPI(UsdPhysics.CollisionAPI)]
        assert len(pieces) == len(contents[name].hulls)
        normals = UsdGeom.PrimvarsAPI(look.GetPrim()).GetPrimvar("normals")
        assert normals.GetInterpolation() == "faceVarying"
        flat = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        sides = np.array(normals.ComputeFlattened()).reshape(-1, 3, 3) @ matrix[:3, :3]
        assert np.einsum("fkj,fj->fk", sides, flat).min() > 0.0, "all point outwards"
    assert stage.GetPrimAtPath("/World/obj_000").GetCustomData()["label"] == HOSTILE
    table = stage.GetPrimAtPath("/World/table")
    assert not table.HasAPI(UsdPhysics.RigidBodyAPI)
    assert any(child.HasAPI(UsdPhysics.CollisionAPI) for child in table.GetChildren())


def test_usd_says_what_things_are_and_how_they_are_lit(scene, tmp_path):
    pytest.importorskip("pxr", reason="usd-core is an optional extra")
    from pxr import Usd, UsdGeom, UsdLux, UsdSemantics

    extract_scene(scene, tmp_path / "usd", "usd")
    stage = Usd.Stage.Open(str(tmp_path / "usd" / "scene.usd"))
    found = {}
    for name in ("obj_000", "obj_001", "obj_002", "table"):
        labels = UsdSemantics.LabelsAPI(stage.GetPrimAtPath(f"/World/{name}"), "class")
        found[name] = list(labels.GetLabelsAttr().Get())
    assert found == {"obj_000": [HOSTILE], "obj_001": ["can"], "obj_002": ["cheese"], "table": ["table"]}
    model = scene.model()
    lamp = UsdLux.DistantLight(stage.GetPrimAtPath("/World/lights/lamp_00"))
    matrix = np.array(UsdGeom.XformCache().GetLocalToWorldTransform(lamp.GetPrim()))
    np.testing.assert_allclose(-matrix[2, :3], model.light_dir[0] / np.linalg.norm(model.light_dir[0]), atol=1e-6)
    assert lamp.GetIntensityAttr().Get() == pytest.approx(np.pi * 0.45)
    assert UsdLux.DomeLight(stage.GetPrimAtPath("/World/lights/dome")).GetIntensityAttr().Get() > 0.45


def test_usd_s_camera_sees_what_mujoco_s_sees(tmp_path):
    pytest.importorskip("pxr", reason="usd-core is an optional extra")
    from pxr import Gf, Usd, UsdGeom

    camera = Camera(600.0, 620.0, 300.5, 251.0, 640, 480)
    down = Pose(np.array([0.1, -0.2, 0.5]), np.array([0.0, 1.0, 0.0, 0.0]))
    body = make_scene_body("obj_000", ball(0.03), (ball(0.03),), 1.0, 0.3, identity_pose())
    files = make_scene_files([body], fit_slab(TABLE, [], [], []), view=PosedCamera(camera, down))
    data = encode_usd(read_model_contents(files.model()), {})
    (tmp_path / "scene.usd").write_bytes(data["scene.usd"])
    stage = Usd.Stage.Open(str(tmp_path / "scene.usd"))
    eye = UsdGeom.Camera(stage.GetPrimAtPath("/World/cameras/camera_00")).GetCamera(Usd.TimeCode.Default())
    view = eye.frustum.ComputeViewMatrix() * eye.frustum.ComputeProjectionMatrix()
    points = np.array([[0.15, -0.25, 0.0], [0.0, -0.1, 0.1]])
    for point, expected in zip(points, project(transform_points(invert_pose(down), points), camera), strict=True):
        x, y, _ = view.Transform(Gf.Vec3d(*point.tolist()))
        np.testing.assert_allclose([320 * (1 + x) - 0.5, 240 * (1 - y) - 0.5], expected, atol=1e-2)


@pytest.mark.parametrize("file_format", FORMATS)
def test_equal_scenes_give_equal_files(file_format, scene, tmp_path):
    if file_format == "usd":
        pytest.importorskip("pxr", reason="usd-core is an optional extra")
    for folder in ("a", "b"):
        extract_scene(scene, tmp_path / folder, file_format)
    names = [path.relative_to(tmp_path / "a") for path in sorted((tmp_path / "a").rglob("*")) if path.is_file()]
    assert names
    for name in names:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


@pytest.mark.parametrize("file_format", FORMATS)
def test_a_body_that_is_no_file_name_is_refused(file_format, scene, tmp_path):
    if file_format == "usd":
        pytest.importorskip("pxr", reason="usd-core is an optional extra")
    files = scene.files()
    files["scene.xml"] = files["scene.xml"].replace(b'body name="obj_001"', b'body name="../../obj_001"')
    bad = Scene("scene", {}, files)
    with pytest.raises(InputError, match="cannot be a file"):
        extract_scene(bad, tmp_path / "new", file_format)
    assert not (tmp_path / "new").exists()
    assert not list(Path(tmp_path).rglob("*.obj"))


def _bodies(*names: str) -> bytes:
    """Boxes in a row that only collide, each with two that are only looked at."""
    looks = [
        f'<geom type="box" size=".02 .02 .02" pos="0 0 {z}" contype="0" conaffinity="0" group="2"/>' for z in (1, 2)
    ]
    solid = '<geom type="box" size=".1 .1 .1" group="3"/>'
    rows = [f'<body name="{n}" pos="{i} 0 0"><freejoint/>{solid}{"".join(looks)}</body>' for i, n in enumerate(names)]
    return f"<mujoco><worldbody>{''.join(rows)}</worldbody></mujoco>".encode()


@pytest.mark.parametrize("names", [("scene", "b"), ("Scene", "b"), ("a", "a_look_01"), ("B", "b")])
def test_no_object_takes_a_urdf_file_from_another(names, tmp_path):
    bad = Scene("scene", {}, {"scene.xml": _bodies(*names), "meta.json": b'{"objects": []}'})
    with pytest.raises(InputError, match="would be called") as caught:
        extract_scene(bad, tmp_path / "new", "urdf")
    assert caught.value.reason == "bad_name"
    assert not (tmp_path / "new").exists()


def test_no_object_takes_the_link_of_the_surroundings(tmp_path):
    xml = _bodies("surroundings", "b").replace(b"<worldbody>", b'<worldbody><geom type="box" size="1 1 .1"/>')
    bad = Scene("scene", {}, {"scene.xml": xml, "meta.json": b'{"objects": []}'})
    with pytest.raises(InputError, match="two links"):
        extract_scene(bad, tmp_path / "new", "urdf")


def test_each_object_has_its_files_in_urdf(tmp_path):
    good = Scene("scene", {}, {"scene.xml": _bodies("a", "b_look_01"), "meta.json": b'{"objects": []}'})
    paths = extract_scene(good, tmp_path / "new", "urdf")
    names = {path.relative_to(tmp_path / "new").as_posix() for path in paths}
    assert {"scene.urdf", "a.urdf", "b_look_01.urdf", "meshes/a_look_01.obj", "meshes/b_look_01.obj"} <= names


def test_the_masses_are_those_of_the_verdict(scene):
    verdicts = {item["object_id"]: item["mass_kg"] for item in scene.meta["assessment"]["objects"]}
    contents = {content.name: content.mass_kg for content in read_model_contents(scene.model()).objects}
    assert contents == pytest.approx(verdicts)


def test_contents_are_in_the_frame_of_the_body(scene, standing):
    for content in read_model_contents(scene.model()).objects:
        (look,) = content.looks
        world = place_mesh(look.mesh, content.pose)
        assert np.abs(world.vertices[world.faces] - standing[content.name]).max() < 1e-6


@pytest.mark.parametrize(
    "meta", [b"nope", b"[]", b'{"objects": 3}', b'{"objects": [3]}', b'{"objects": [{}]}', b"[" * 9999]
)
def test_a_meta_of_no_scene_is_refused(meta, scene, tmp_path):
    with pytest.raises(InputError, match=r"meta\.json"):
        extract_scene(Scene("scene", {}, {**scene.files(), "meta.json": meta}), tmp_path / "new", "urdf")


def test_what_no_detector_named_is_called_by_the_judge_or_as_its_id():
    objects = [
        {"object_id": "obj_000", "label": "object"},
        {"object_id": "obj_001"},
        {"object_id": "obj_002", "label": "mug"},
        {"object_id": "obj_003", "label": "object"},
    ]
    judged = {"objects": [{"object_id": f"obj_00{k}", "relabel_name": "white bowl"} for k in (0, 2)]}
    assert read_labels({"objects": objects, "assessment": judged}) == {
        "obj_000": "white bowl",
        "obj_001": "obj_001",
        "obj_002": "mug",
        "obj_003": "obj_003",
    }
