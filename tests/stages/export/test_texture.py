"""Textures: every corner shows its vertex's colour, what the picture shows is on the mesh, what it hides is not."""

import io
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from PIL import Image

from schemas.geometry import Camera, Pose, Texture, TriangleMesh
from schemas.objects import Evidence
from tableverse_factory.geometry.mesh.meshes import concatenate_meshes, from_trimesh
from tableverse_factory.stages.export.atlas import find_corner_texels, lay_out_atlas, list_triangle_texels
from tableverse_factory.stages.export.projected_color import PhotographedMesh, load_projectors
from tableverse_factory.stages.export.texture import bake_texture
from tests.helpers.simple_scenes import UPRIGHT, box


def colored(mesh: TriangleMesh, seed: int = 0) -> TriangleMesh:
    colors = np.random.default_rng(seed).integers(0, 256, (len(mesh.vertices), 3), dtype=np.uint8)
    return TriangleMesh(mesh.vertices, mesh.faces, colors)


def texels_at(png: bytes, uv: np.ndarray) -> np.ndarray:
    picture = np.asarray(Image.open(io.BytesIO(png)))
    height, width = picture.shape[:2]
    column, row = uv[..., 0] * width - 0.5, (1.0 - uv[..., 1]) * height - 0.5
    np.testing.assert_allclose(column, np.rint(column), atol=1e-9)
    np.testing.assert_allclose(row, np.rint(row), atol=1e-9)
    found: np.ndarray = picture[np.rint(row).astype(int), np.rint(column).astype(int)].astype(float)
    return found


def test_a_mesh_without_colours_has_no_texture() -> None:
    assert bake_texture(box(0.1, 0.1, 0.1)) is None


def test_a_mesh_keeps_its_own_texture() -> None:
    picture = np.random.default_rng(0).integers(0, 256, (5, 7, 3), dtype=np.uint8)
    uv = np.random.default_rng(1).random((12, 3, 2))
    cube = box(0.1, 0.1, 0.1)
    appearance = bake_texture(TriangleMesh(cube.vertices, cube.faces, texture=Texture(picture, uv)))
    assert appearance is not None
    np.testing.assert_array_equal(np.asarray(Image.open(io.BytesIO(appearance.texture_png))), picture)
    np.testing.assert_array_equal(appearance.corner_uv, uv)


@pytest.mark.parametrize("subdivisions", [0, 2, 3])
def test_every_corner_has_the_colour_of_its_vertex(subdivisions: int) -> None:
    mesh = colored(from_trimesh(trimesh.creation.icosphere(subdivisions, 0.03)))
    appearance = bake_texture(mesh)
    assert appearance is not None
    assert mesh.vertex_colors is not None
    expected = mesh.vertex_colors[mesh.faces].astype(float)
    np.testing.assert_allclose(texels_at(appearance.texture_png, appearance.corner_uv), expected, atol=1.0)


def test_a_dense_mesh_gets_one_colour_per_face() -> None:
    mesh = colored(from_trimesh(trimesh.creation.icosphere(5, 0.03)))  # 20,480 faces
    appearance = bake_texture(mesh)
    assert appearance is not None
    assert mesh.vertex_colors is not None
    assert (appearance.corner_uv == appearance.corner_uv[:, :1]).all()
    mean = mesh.vertex_colors[mesh.faces].astype(float).mean(axis=1)
    np.testing.assert_allclose(texels_at(appearance.texture_png, appearance.corner_uv[:, 0]), mean, atol=1.0)
    assert Image.open(io.BytesIO(appearance.texture_png)).size[0] <= 256


def test_equal_meshes_give_equal_bytes() -> None:
    first, again = (bake_texture(colored(from_trimesh(trimesh.creation.icosphere(3, 0.03)))) for _ in range(2))
    assert first is not None
    assert again is not None
    assert first.texture_png == again.texture_png


@pytest.mark.parametrize(
    "density", [500.0, *(pytest.param(density, marks=pytest.mark.slow) for density in (0.0, 2000.0))]
)
def test_no_texel_belongs_to_two_faces(density: float) -> None:
    mesh = from_trimesh(trimesh.creation.icosphere(3, 0.03))
    atlas = lay_out_atlas(mesh, np.full(len(mesh.faces), density), 512)
    assert atlas is not None
    owner = np.full((512, 512), -1)
    for face in range(len(mesh.faces)):
        texels, weights = list_triangle_texels(int(atlas.square[face]), bool(atlas.second[face]))
        column, row = (atlas.corner[face] + texels).T
        assert (owner[row, column] == -1).all()
        owner[row, column] = face
        np.testing.assert_allclose(weights.sum(axis=1), 1.0)
        assert weights.min() >= 0.0
    corners = find_corner_texels(atlas)
    assert (owner[corners[..., 1], corners[..., 0]] == np.arange(len(mesh.faces))[:, None]).all()


def test_a_texture_too_small_is_said_to_be() -> None:
    mesh = from_trimesh(trimesh.creation.icosphere(3, 0.03))
    assert lay_out_atlas(mesh, np.full(len(mesh.faces), 1e5), 256) is None


CAMERA = Camera(500.0, 500.0, 159.5, 119.5, 320, 240)
LOOKING_DOWN = Pose(np.array([0.0, 0.0, 0.5]), np.array([0.0, 1.0, 0.0, 0.0]))


def evidence_of_a_card(ids: np.ndarray) -> Evidence:
    """A picture that is red on its left half and blue on its right, taken from straight above."""
    color = np.zeros((240, 320, 3), dtype=np.uint8)
    color[:, :160, 0], color[:, 160:, 2] = 250, 250
    jpg, png = io.BytesIO(), io.BytesIO()
    Image.fromarray(color).save(jpg, "JPEG", quality=98, subsampling=0)
    Image.fromarray(ids.astype(np.uint16)).save(png, "PNG")
    return Evidence(jpg.getvalue(), png.getvalue(), (7,), CAMERA, LOOKING_DOWN)


def top_and_bottom(scale: float, ids: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What the texture of a grey card shows above, in the channel of that half of the picture, and below."""
    card = from_trimesh(trimesh.creation.box((0.2 / scale, 0.1 / scale, 0.02 / scale)).subdivide().subdivide())
    grey = TriangleMesh(card.vertices, card.faces, np.full((len(card.vertices), 3), 99, dtype=np.uint8))
    (photograph,) = load_projectors(evidence_of_a_card(ids), [Pose(np.array([0.0, 0.0, 0.01]), UPRIGHT)], [scale])
    appearance = bake_texture(grey, photograph)
    assert appearance is not None
    colors = texels_at(appearance.texture_png, appearance.corner_uv)
    corners = card.vertices[card.faces] * scale
    normal_z = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    flat = np.ptp(corners[:, :, 2], axis=1) < 1e-9
    x, y = np.abs(corners[..., 0]), np.abs(corners[..., 1])
    clear = (flat & (normal_z > 0))[:, None] & (x > 0.01) & (x < 0.09) & (y < 0.04)
    own_channel = np.where(corners[..., 0] < 0, colors[..., 0], colors[..., 2])
    return own_channel[clear], colors[flat & (normal_z < 0)].ravel()


@pytest.mark.parametrize("scale", [1.0, 0.01])
def test_what_the_picture_shows_is_on_the_mesh_and_nowhere_else(scale: float) -> None:
    upper, lower = top_and_bottom(scale, np.full((240, 320), 7))
    assert len(upper) > 10
    assert (upper > 230).all()
    np.testing.assert_allclose(lower, 99, atol=1)


def test_pixels_of_another_object_are_not_taken() -> None:
    upper, _ = top_and_bottom(1.0, np.full((240, 320), 3))
    np.testing.assert_allclose(upper, 99, atol=1)


def test_just_behind_an_edge_the_picture_shows_no_colour_where_depth_was_estimated() -> None:
    """The edge of a mesh that is not exact may show there: the picture of a rim on the floor of its cup."""
    floor, lid = (from_trimesh(trimesh.creation.box(size)) for size in ((0.2, 0.14, 0.01), (0.08, 0.06, 0.01)))
    raised = TriangleMesh(lid.vertices + np.array([0.0, 0.0, 0.1]), lid.faces)
    mesh = concatenate_meshes([floor, raised])
    edge = 0.04 * 0.495 / 0.395  # of the lid, as it looks on the floor
    on_floor = np.array([[edge + 0.002, 0.0, 0.005], [edge + 0.03, 0.0, 0.005]])
    face = int(np.flatnonzero((mesh.vertices[mesh.faces][:, :, 2] == 0.005).all(axis=1))[0])
    evidence = evidence_of_a_card(np.full((240, 320), 7))
    for source, shown in (("sensor", [0, 1]), ("estimated", [1])):
        (photograph,) = load_projectors(replace(evidence, scale_source=source), [Pose(np.zeros(3), UPRIGHT)], [1.0])
        found, _ = PhotographedMesh(photograph, mesh).find_shown(on_floor, np.array([face, face]))
        assert found.tolist() == shown
