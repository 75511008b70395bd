"""Meshes with pictures, from the file to MuJoCo: colours stay, right side up, and no name leads out of the folder."""

import io
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual.material import PBRMaterial

from schemas.config import Config, ObserveConfig
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done, Dropped, Outcome
from schemas.scene import ExportedScene
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.meshes import read_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.sources.content_hash import hash_entry
from tableverse_factory.stages.export.export import export
from tableverse_factory.stages.observe.observe import read_layout
from tableverse_factory.stages.rectify.rectify import rectify
from tableverse_factory.stages.settle import settle
from tests.helpers.simple_scenes import curated

RED, BLUE, GREEN, WHITE = (220, 30, 30), (20, 60, 200), (30, 160, 40), (240, 240, 240)
OBJ = """mtllib box.mtl
v -0.05 0 0
v 0.05 0 0
v 0.05 0 0.1
v -0.05 0 0.1
v -0.05 0.1 0
v 0.05 0.1 0
v 0.05 0.1 0.1
v -0.05 0.1 0.1
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl painted
f 1/1 2/2 3/3 4/4
f 2/1 6/2 7/3 3/4
f 6/1 5/2 8/3 7/4
f 5/1 1/2 4/3 8/4
usemtl plain
f 4 3 7 8
f 1 5 6 2
"""
MTL = "newmtl painted\nKd 0 0 0\nmap_Kd pictures/front.png\nnewmtl plain\nKd 0.2 0.4 0.6\n"


def four_colors(size: int = 64) -> Image.Image:
    """Red above left, blue above right, green below left, white below right."""
    pixels = np.zeros((size, size, 3), dtype=np.uint8)
    half = size // 2
    pixels[:half, :half], pixels[:half, half:] = RED, BLUE
    pixels[half:, :half], pixels[half:, half:] = GREEN, WHITE
    return Image.fromarray(pixels)


def png(image: Image.Image) -> bytes:
    out = io.BytesIO()
    image.save(out, "PNG")
    return out.getvalue()


def glb(factor: list[float] | None = None) -> bytes:
    """A box 0.1 m large, standing on y = 0, as glTF has it; its front (+z there, -y here) shows the picture."""
    x, y, z = 0.05, 0.1, 0.05
    front = [[-x, 0, z], [x, 0, z], [x, y, z], [-x, y, z]]
    back = [[x, 0, -z], [-x, 0, -z], [-x, y, -z], [x, y, -z]]
    vertices = np.array(front + back)
    faces = [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7], [3, 2, 7], [3, 7, 6], [1, 0, 5], [1, 5, 4]]
    faces += [[1, 4, 7], [1, 7, 2], [5, 0, 3], [5, 3, 6]]
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]] * 2, dtype=float)
    material = PBRMaterial(baseColorTexture=four_colors(), baseColorFactor=factor)
    visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return bytes(trimesh.Trimesh(vertices, faces, visual=visual, process=False).export(file_type="glb"))


def layout_of(folder: Path, mesh: str, content: bytes) -> ImageRow:
    (folder / "layouts").mkdir()
    (folder / "meshes").mkdir()
    (folder / "meshes" / mesh).write_bytes(content)
    pose = {"position": [0, 0, 0.0005], "quaternion_wxyz": [1, 0, 0, 0]}
    item = {"id": "obj_000", "label": "box", "mesh": f"../meshes/{mesh}", "scale": 1.0, "pose": pose}
    (folder / "layouts" / "one.json").write_text(json.dumps({"objects": [item]}))
    return ImageRow(scene_id="one", kind=SceneKind.LAYOUT, uri=str(folder / "layouts" / "one.json"))


def with_pictures(folder: Path, obj: str = OBJ, mtl: str = MTL) -> ImageRow:
    row = layout_of(folder, "box.obj", obj.encode())
    (folder / "meshes" / "box.mtl").write_text(mtl)
    (folder / "meshes" / "pictures").mkdir()
    (folder / "meshes" / "pictures" / "front.png").write_bytes(png(four_colors()))
    return row


def built(row: ImageRow, cache: Path) -> Outcome[ExportedScene]:
    item, rng = row, np.random.default_rng(0)
    for stage in (read_layout, rectify, settle):
        outcome = stage(item, Config(), rng, Services(cache))  # type: ignore[arg-type]
        if not isinstance(outcome, Done):
            return outcome
        item = outcome.value
    return export(curated(item), Config(), rng, Services(cache))  # type: ignore[arg-type]


def front_colors(scene: ExportedScene) -> list[np.ndarray]:
    """What the exported files say of four points on the face towards -y: above left and right, below left and right.

    Found in MuJoCo's compiled model: the triangle at each point, its texture coordinates, the texel there.
    """
    files = dict(scene.files)
    assets = {name: data for name, data in files.items() if name.startswith("assets/")}
    model = mujoco.MjModel.from_xml_string(files["scene.xml"].decode(), assets)
    geom = model.geom("obj_000")
    material = model.mat(int(geom.matid[0]))
    texture = int(material.texid[mujoco.mjtTextureRole.mjTEXROLE_RGB])
    assert texture >= 0
    height, width, start = model.tex_height[texture], model.tex_width[texture], model.tex_adr[texture]
    texels = model.tex_data[start : start + 3 * height * width].reshape(height, width, 3)
    mesh = trimesh.load(io.BytesIO(files["assets/obj_000.obj"]), file_type="obj", process=False)
    low, high = mesh.bounds
    colors = []
    for x, z in ((0.25, 0.75), (0.75, 0.75), (0.25, 0.25), (0.75, 0.25)):
        point = np.array([low[0] + x * (high[0] - low[0]), low[1], low[2] + z * (high[2] - low[2])])
        triangle = _face_at(mesh, point)
        weights = trimesh.triangles.points_to_barycentric(mesh.triangles[[triangle]], point[None])[0]
        u, v = weights @ mesh.visual.uv[mesh.faces[triangle]]
        colors.append(texels[int((1.0 - v) * height), int(u * width)])
    return colors


def _face_at(mesh: trimesh.Trimesh, point: np.ndarray) -> int:
    facing = np.flatnonzero(mesh.face_normals[:, 1] < -0.9)
    weights = trimesh.triangles.points_to_barycentric(mesh.triangles[facing], np.tile(point, (len(facing), 1)))
    return int(facing[np.argmax(weights.min(axis=1))])


def near(colors: list[np.ndarray], *expected: tuple[int, int, int]) -> None:
    np.testing.assert_allclose(np.array(colors, dtype=int), np.array(expected), atol=3)


@pytest.mark.parametrize("kind", ["glb", "obj"])
def test_a_picture_stays_on_its_face_and_right_side_up(kind: str, tmp_path: Path) -> None:
    row = layout_of(tmp_path, "box.glb", glb()) if kind == "glb" else with_pictures(tmp_path)
    outcome = built(row, tmp_path / "cache")
    assert isinstance(outcome, Done), outcome
    near(front_colors(outcome.value), RED, BLUE, GREEN, WHITE)
    assert outcome.value.object_rows[0]["mesh_repaired"] == ""  # seams of the texture are no holes
    assert json.loads(dict(outcome.value.files)["meta.json"])["objects"][0]["appearance"] == "texture"


def test_the_colour_factor_of_gltf_tints_the_picture_in_linear_light() -> None:
    mesh = read_mesh(glb([0.5, 1.0, 0.0, 1.0]), "box.glb")
    assert mesh.texture is not None
    np.testing.assert_allclose(mesh.texture.picture[0, 0].astype(int), [161, 30, 0], atol=2)


def test_plain_materials_become_colours() -> None:
    beside = {"box.mtl": MTL.encode()}
    mesh = read_mesh(OBJ.encode(), "box.obj", beside)
    assert mesh.texture is None
    assert mesh.vertex_colors is not None
    assert {tuple(color) for color in mesh.vertex_colors.tolist()} == {(0, 0, 0), (51, 102, 153)}


def test_an_absent_material_costs_the_colours_only(tmp_path: Path) -> None:
    outcome = built(layout_of(tmp_path, "box.obj", OBJ.encode()), tmp_path / "cache")
    assert isinstance(outcome, Done), outcome
    assert json.loads(dict(outcome.value.files)["meta.json"])["objects"][0]["appearance"] == "palette"


@pytest.mark.parametrize(
    ("obj", "mtl"),
    [
        (OBJ.replace("box.mtl", "/etc/passwd"), MTL),
        (OBJ.replace("box.mtl", "../../../box.mtl"), MTL),
        (OBJ.replace("box.mtl", "http://localhost/box.mtl"), MTL),
        (OBJ, MTL.replace("pictures/front.png", "../../secret.png")),
        (OBJ, MTL.replace("pictures/front.png", "/etc/passwd")),
        (OBJ, MTL.replace("pictures/front.png", "..\\front.png")),
    ],
)
def test_no_name_leads_out_of_the_folder(obj: str, mtl: str, tmp_path: Path) -> None:
    outcome = built(with_pictures(tmp_path, obj, mtl), tmp_path / "cache")
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "bad_mesh_path"


def test_a_link_does_not_lead_out_either(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    row = with_pictures(home)
    (tmp_path / "secret.png").write_bytes(png(four_colors()))
    (home / "meshes/pictures/front.png").unlink()
    (home / "meshes/pictures/front.png").symlink_to(tmp_path / "secret.png")
    outcome = built(row, tmp_path / "cache")
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "bad_mesh_path"


def test_pictures_are_bounded(tmp_path: Path) -> None:
    row = with_pictures(tmp_path)
    config = Config(observe=ObserveConfig(max_pixels=1000))
    outcome = read_layout(row, config, np.random.default_rng(0), Services(tmp_path))
    assert isinstance(outcome, Dropped)
    assert (outcome.reason, "4096 pixels" in outcome.detail) == ("picture_too_large", True)
    (tmp_path / "meshes/pictures/front.png").write_bytes(b"no picture")
    outcome = read_layout(row, Config(), np.random.default_rng(0), Services(tmp_path))
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "bad_texture"


def test_the_scene_is_another_one_when_its_picture_changes(tmp_path: Path) -> None:
    row = with_pictures(tmp_path)
    before = hash_entry(row.kind, row.uri, ObserveConfig())
    (tmp_path / "meshes/pictures/front.png").write_bytes(png(four_colors(32)))
    assert hash_entry(row.kind, row.uri, ObserveConfig()) != before


def test_points_beyond_the_picture_wrap_around_it() -> None:
    turned = OBJ.replace("vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1", "vt 3 -2\nvt 4 -2\nvt 4 -1\nvt 3 -1")
    beside = {"box.mtl": MTL.encode(), "pictures/front.png": png(four_colors())}
    plain, wrapped = read_mesh(OBJ.encode(), "box.obj", beside), read_mesh(turned.encode(), "box.obj", beside)
    assert plain.texture is not None
    assert wrapped.texture is not None
    np.testing.assert_allclose(wrapped.texture.corner_uv, plain.texture.corner_uv, atol=1e-6)
    assert len(plain.vertices) == 8
    assert aabb(plain.vertices)[1][2] == pytest.approx(0.1)


def test_many_instances_of_one_mesh_are_counted_before_they_are_made() -> None:
    scene = trimesh.Scene()
    ball = trimesh.creation.icosphere(4)
    scene.add_geometry(ball, geom_name="ball")
    for k in range(2000):
        scene.graph.update(f"n{k}", matrix=np.eye(4), geometry="ball")
    with pytest.raises(Exception, match="at most 5000000"):
        read_mesh(scene.export(file_type="glb"), "many.glb")
