"""Meshes: every format gives the same triangles, volumes are analytic, and hostile files give one clear error."""

import io
import json
import math
import struct

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.transforms import quaternion_about_z
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume
from tableverse_factory.geometry.mesh.mesh_colors import MAX_SHEET, MAX_SIDE, _arrange_pictures, _choose_side
from tableverse_factory.geometry.mesh.meshes import (
    MAX_FACES,
    box_center,
    check_mesh,
    from_trimesh,
    place_mesh,
    read_mesh,
    to_trimesh,
)
from tests.helpers.examples import scale_examples

BOX = trimesh.creation.box((0.1, 0.2, 0.3))
FILES = {suffix: BOX.export(file_type=suffix) for suffix in ("obj", "ply", "stl", "glb")}
FILES = {suffix: data.encode() if isinstance(data, str) else data for suffix, data in FILES.items()}


@pytest.mark.parametrize("suffix", ["obj", "ply", "stl"])
def test_a_box_comes_through_every_format(suffix):
    mesh = read_mesh(FILES[suffix], f"box.{suffix}")
    low, high = aabb(mesh.vertices)
    np.testing.assert_allclose(high - low, [0.1, 0.2, 0.3], atol=1e-6)
    assert compute_signed_volume(mesh) == pytest.approx(0.006, rel=1e-5)
    assert mesh.vertices.dtype == np.float64
    assert mesh.faces.dtype == np.int32


@pytest.mark.parametrize("suffix", ["ply", "glb"])
def test_vertices_of_no_face_are_dropped_before_anything_is_measured(suffix):
    loose = trimesh.Trimesh([*BOX.vertices, [0, 0, -5e6]], BOX.faces, vertex_colors=np.arange(36).reshape(9, 4))
    mesh = read_mesh(loose.export(file_type=suffix), f"box.{suffix}")
    assert len(mesh.vertices) == 8
    assert np.abs(mesh.vertices).max() == pytest.approx(0.15)
    assert compute_signed_volume(mesh) == pytest.approx(0.006, rel=1e-5)


def test_glb_is_turned_from_y_up():
    mesh = read_mesh(FILES["glb"], "box.glb")
    low, high = aabb(mesh.vertices)
    np.testing.assert_allclose(high - low, [0.1, 0.3, 0.2], atol=1e-6)
    tip = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 1.0, 0]], [[0, 1, 2]], process=False).export(file_type="glb")
    assert aabb(read_mesh(tip, "tip.glb").vertices)[1][2] == pytest.approx(1.0)  # what was up is up
    assert compute_signed_volume(mesh) == pytest.approx(0.006, rel=1e-5)  # turned, not mirrored


@given(st.floats(0.01, 2.0), st.floats(0.01, 2.0), st.floats(0.01, 2.0), st.floats(-3.0, 3.0), st.floats(0.1, 3.0))
def test_volume_is_analytic_and_moves_with_the_mesh(a, b, c, angle, scale):
    box = from_trimesh(trimesh.creation.box((a, b, c)))
    assert compute_signed_volume(box) == pytest.approx(a * b * c)
    pose = Pose(np.array([1.0, -2.0, 0.5]), quaternion_about_z(angle))
    moved = place_mesh(box, pose, scale)
    assert compute_signed_volume(moved) == pytest.approx(a * b * c * scale**3)
    np.testing.assert_allclose(moved.vertices.mean(axis=0), pose.position, atol=1e-9)
    inside_out = TriangleMesh(box.vertices, box.faces[:, ::-1])
    assert compute_signed_volume(inside_out) == pytest.approx(-a * b * c)


def test_the_box_centre_is_between_the_corners():
    mesh = TriangleMesh(np.array([[0.0, 0, 0], [2, 0, 0], [0, 4, 6]]), np.array([[0, 1, 2]], dtype=np.int32))
    np.testing.assert_array_equal(box_center(mesh), [1, 2, 3])


def test_colours_survive_the_bridge_to_trimesh():
    colors = np.arange(24, dtype=np.uint8).reshape(8, 3)
    mesh = TriangleMesh(np.array(BOX.vertices), np.array(BOX.faces, dtype=np.int32), colors)
    there_and_back = from_trimesh(to_trimesh(mesh))
    np.testing.assert_array_equal(there_and_back.vertex_colors, colors)
    np.testing.assert_array_equal(there_and_back.vertices, mesh.vertices)
    np.testing.assert_array_equal(there_and_back.faces, mesh.faces)


def test_the_bridge_shares_nothing():
    mesh = from_trimesh(BOX)
    to_trimesh(mesh).vertices[:] = 7.0
    assert aabb(mesh.vertices)[1].max() < 1.0


def obj(*lines: str) -> bytes:
    return "\n".join(lines).encode()


def glb(document: dict, binary: bytes = b"") -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(binary), 0x004E4942) + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


HOSTILE = {
    "empty.obj": b"",
    "empty.ply": b"",
    "empty.stl": b"",
    "empty.glb": b"",
    "noise.obj": bytes(range(256)) * 8,
    "noise.ply": bytes(range(256)) * 8,
    "noise.stl": bytes(range(256)) * 8,
    "noise.glb": bytes(range(256)) * 8,
    "nan.obj": obj("v nan 0 0", "v 1 0 0", "v 0 1 0", "f 1 2 3"),
    "infinite.obj": obj("v inf 0 0", "v 1 0 0", "v 0 1 0", "f 1 2 3"),
    "points_only.obj": obj("v 0 0 0", "v 1 0 0", "v 0 1 0"),
    "missing_vertex.obj": obj("v 0 0 0", "v 1 0 0", "v 0 1 0", "f 1 2 9"),
    "negative.obj": obj("v 0 0 0", "v 1 0 0", "v 0 1 0", "f 1 2 -9"),
    "a_point.obj": obj("v 1 1 1", "v 1 1 1", "v 1 1 1", "f 1 2 3"),
    "galaxy.obj": obj("v 0 0 0", "v 1e20 0 0", "v 0 1e20 0", "f 1 2 3"),
    "overflow.obj": obj("v 0 0 0", "v 1e300 0 0", "v 0 -1e308 0", "v 0 1e308 0", "f 1 2 3", "f 2 3 4"),
    "words.obj": obj("v a b c", "f x y z"),
    "lies.ply": b"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\nproperty float x\nproperty float y\n"
    b"property float z\nelement face 4000000000\nproperty list uchar int vertex_indices\nend_header\n\0\0",
    "ascii_lies.ply": b"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nelement face 1\n"
    b"property list uchar int vertex_indices\nend_header\n1\n2\n",
    "lies.stl": b"\0" * 80 + struct.pack("<I", 2**32 - 1) + b"\0" * 50,
    "lies.glb": struct.pack("<4sII", b"glTF", 2, 2**31) + struct.pack("<II", 2**31, 0x4E4F534A) + b"{}",
    "no_mesh.glb": glb({"asset": {"version": "2.0"}, "scenes": [{"nodes": []}], "scene": 0}),
    "deep.glb": glb(
        {"asset": {"version": "2.0"}, "nodes": [{"children": [0]}], "scenes": [{"nodes": [0]}], "scene": 0}
    ),
    "file.exe": b"MZ",
    "no_ending": b"v 0 0 0",
    "traversal.obj/../../etc/passwd": b"root",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_file_is_one_clear_error(name):
    with pytest.raises(GeometryError) as caught:
        read_mesh(HOSTILE[name], name)
    message = str(caught.value)
    assert name in message
    assert " at 0x" not in message, "an address in memory is another one in every run"
    assert len(message) < 700


def test_other_files_are_never_opened(tmp_path, monkeypatch):
    """A material library outside is a hole in some readers."""
    secret = tmp_path / "secret.mtl"
    secret.write_text("newmtl a\nmap_Kd /etc/passwd\n")
    monkeypatch.chdir(tmp_path)
    text = obj(f"mtllib {secret}", "mtllib secret.mtl", "usemtl a", "v 0 0 0", "v 1 0 0", "v 0 1 0", "f 1 2 3")
    before = secret.stat().st_atime_ns
    assert len(read_mesh(text, "a.obj").faces) == 1
    assert secret.stat().st_atime_ns == before


@pytest.mark.parametrize("suffix", FILES)
def test_a_truncated_file_is_an_error_or_a_smaller_mesh(suffix):
    data = FILES[suffix]
    for cut in np.linspace(0, len(data) - 1, 25).astype(int):
        try:
            mesh = read_mesh(data[:cut], f"box.{suffix}")
        except GeometryError:
            continue
        assert np.isfinite(mesh.vertices).all()
        assert int(mesh.faces.max()) < len(mesh.vertices)


@pytest.mark.heavy
@settings(max_examples=scale_examples(150), deadline=None)
@given(st.sampled_from(sorted(FILES)), st.integers(0, 2**32 - 1))
def test_damaged_files_never_give_numbers_that_cannot_be_computed_with(suffix, seed):
    rng = np.random.default_rng(seed)
    data = bytearray(FILES[suffix])
    for position in rng.integers(0, len(data), rng.integers(1, 12)):
        data[position] = rng.integers(0, 256)
    try:
        mesh = read_mesh(bytes(data), f"box.{suffix}")
    except GeometryError:
        return
    assert np.isfinite(mesh.vertices).all()
    assert int(mesh.faces.min()) >= 0
    assert int(mesh.faces.max()) < len(mesh.vertices)


def test_too_many_triangles_are_refused():
    faces = np.zeros((MAX_FACES + 1, 3), dtype=np.int32)
    faces[:, 1], faces[:, 2] = 1, 2
    with pytest.raises(GeometryError, match=str(MAX_FACES)):
        check_mesh(TriangleMesh(np.eye(3), faces), "many")


@pytest.mark.shared
def test_scanned_meshes_are_whole(shared_dir):
    for path in sorted((shared_dir / "meshes").glob("*.obj"))[:8]:
        mesh = read_mesh(path.read_bytes(), path.name)
        low, high = aabb(mesh.vertices)
        assert 0.005 < (high - low).max() < 0.6, path.name  # metres: hand-sized things


def paint_many(count: int, side: int, plain: int = 0) -> bytes:
    """A GLB of `count` squares, each with a picture of its own, and of `plain` ones of a colour."""
    scene = trimesh.Scene()
    for k in range(count + plain):
        square = trimesh.Trimesh([[k, 0, 0], [k + 0.9, 0, 0], [k, 0.9, 0]], [[0, 1, 2]], process=False)
        color = (9 * k, 255 - 9 * k, 40)
        if k < count:
            material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.new("RGB", (side, side), color))
        else:
            material = trimesh.visual.material.PBRMaterial(baseColorFactor=(*color, 255))
        square.visual = trimesh.visual.TextureVisuals(np.array([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]), material)
        scene.add_geometry(square, geom_name=f"square_{k}")
    return scene.export(file_type="glb")


def read_colors(mesh: TriangleMesh) -> np.ndarray:
    """The red of the picture in the middle of each face, in the order of the squares."""
    assert mesh.texture is not None
    height, width = mesh.texture.picture.shape[:2]
    middles = mesh.texture.corner_uv.mean(axis=1)
    columns, rows = np.int64(middles[:, 0] * width), np.int64((1.0 - middles[:, 1]) * height)
    order = np.argsort(mesh.vertices[mesh.faces][:, :, 0].min(axis=1))
    return mesh.texture.picture[rows, columns, 0].astype(int)[order]


@pytest.mark.parametrize("plain", [0, 2])
@pytest.mark.parametrize("count", [1, 2, 3, 5, 8, 13, 20])
def test_many_pictures_fit_into_one_sheet_and_stay_sharp(count, plain):
    mesh = read_mesh(paint_many(count, 512, plain), "many.glb")
    assert mesh.texture is not None
    height, width = mesh.texture.picture.shape[:2]
    assert max(height, width) <= 4096
    assert height * width >= count * 512 * 512  # none was reduced
    given = 9 * np.arange(count + plain) / 255.0
    linear = np.where(given <= 0.0031308, 12.92 * given, 1.055 * given ** (1 / 2.4) - 0.055)  # as glTF gives a factor
    wanted = 255.0 * np.where(np.arange(count + plain) < count, given, linear)
    assert np.abs(read_colors(mesh) - wanted).max() <= 1


def test_a_large_picture_beside_small_ones_keeps_its_size():
    sizes = {"large": (2048, 2048), **{f"small {k}": (64, 64) for k in range(100)}}
    assert _choose_side(sizes) == MAX_SIDE


@pytest.mark.parametrize("count", range(1, 26))
def test_pictures_of_any_number_fit_into_the_sheet(count):
    sizes = {str(k): (2048, 2048) for k in range(count)}
    side = _choose_side(sizes)
    assert _arrange_pictures(dict.fromkeys(sizes, (side, side)))[1].max() <= MAX_SHEET
    assert side >= 0.9 * min(MAX_SIDE, MAX_SHEET // math.ceil(math.sqrt(count)))


def test_plain_colours_alone_make_a_square():
    assert _arrange_pictures({str(k): (1, 1) for k in range(5000)})[1].max() <= 71


def test_materials_of_one_file_have_its_picture_once(tmp_path):
    """An OBJ's materials open it anew each."""
    picture = io.BytesIO()
    Image.new("RGB", (1024, 1024), (200, 30, 40)).save(picture, "PNG")
    lines = ["mtllib many.mtl", *(f"v {x} {y} 0" for x, y in ((0, 0), (1, 0), (0, 1))), "vt 0 0", "vt 1 0", "vt 0 1"]
    lines += [f"usemtl m{k}\nf 1/1 2/2 3/3" for k in range(12)]
    library = "\n".join(f"newmtl m{k}\nmap_Kd one.png" for k in range(12))
    beside = {"many.mtl": library.encode(), "one.png": picture.getvalue()}
    mesh = read_mesh("\n".join(lines).encode(), "many.obj", beside, max_pixels=1024 * 1024)
    assert mesh.texture is not None
    assert mesh.texture.picture.shape == (1024, 1024, 3)


def test_pictures_of_too_many_pixels_together_are_refused():
    with pytest.raises(GeometryError, match="all textures of 5242880 pixels; at most 4800000"):
        read_mesh(paint_many(20, 512), "many.glb", max_pixels=1_200_000)


def embed(picture: bytes, **image: object) -> bytes:
    """A GLB of a triangle with this picture."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], "<f4").tobytes()
    binary = corners + np.array([[0, 0], [1, 0], [0, 1]], "<f4").tobytes()
    views = [(0, 36), (36, 24), (60, len(picture))]
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0}]}],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}],
        "textures": [{"source": 0}],
        "images": [image or {"bufferView": 2, "mimeType": "image/png"}],
        "accessors": [
            {"bufferView": k, "componentType": 5126, "count": 3, "type": kind}
            for k, kind in enumerate(("VEC3", "VEC2"))
        ],
        "bufferViews": [{"buffer": 0, "byteOffset": start, "byteLength": size} for start, size in views],
        "buffers": [{"byteLength": len(binary) + len(picture)}],
    }
    return glb(document, binary + picture + b"\0" * (-len(binary + picture) % 4))


def make_png(*size: int) -> bytes:
    data = io.BytesIO()
    Image.new("1", size, 1).save(data, "PNG")
    return data.getvalue()


def test_a_glb_shows_its_picture():
    mesh = read_mesh(embed(make_png(8, 8)), "good.glb")
    assert mesh.texture is not None
    assert (mesh.texture.picture == 255).all()


@pytest.mark.parametrize(
    ("data", "said"),
    [
        pytest.param(embed(b"\x89PNG\r\n\x1a\nnothing"), "cannot identify image", id="damaged"),
        pytest.param(embed(make_png(14_000, 14_000)), "exceeds limit", id="a bomb"),
        pytest.param(embed(make_png(8_000, 8_000)), "a texture of 64000000 pixels", id="too large"),
        pytest.param(embed(b"", uri="beside.png"), "lies in another file", id="outside"),
        pytest.param(embed(b"", uri="data:image/png;base64,AAAA"), "cannot identify image", id="a damaged address"),
    ],
)
def test_a_picture_that_cannot_be_shown_is_not_left_out_in_silence(data, said):
    with pytest.raises(GeometryError, match=said):
        read_mesh(data, "picture.glb")
