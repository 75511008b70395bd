import numpy as np
import pytest
import trimesh

from tableverse_factory.geometry.atlas import atlas_of, texel_points
from tableverse_factory.geometry.meshes import from_trimesh

SHAPES = {
    "box": trimesh.creation.box((0.2, 0.3, 0.05)),
    "ball": trimesh.creation.icosphere(3, 0.04),
    "needle": trimesh.creation.box((0.3, 0.001, 0.001)),
}


@pytest.mark.parametrize("name", SHAPES)
@pytest.mark.parametrize("texel_m", [0.0005, 0.002, 0.05])
def test_no_texel_shows_two_faces_and_every_face_has_texels(name, texel_m):
    mesh = from_trimesh(SHAPES[name])
    atlas = atlas_of(mesh, texel_m, 512)
    assert max(atlas.width, atlas.height) <= 512
    assert len(np.unique(atlas.texels)) == len(atlas.texels)
    assert atlas.texels.max() < atlas.width * atlas.height
    assert set(atlas.faces.tolist()) == set(range(len(mesh.faces)))
    assert atlas.weights.min() >= 0.0
    np.testing.assert_allclose(atlas.weights.sum(axis=1), 1.0, atol=1e-12)
    assert atlas.corner_uv.min() > 0.0
    assert atlas.corner_uv.max() < 1.0


@pytest.mark.parametrize("name", SHAPES)
def test_a_texture_of_positions_reads_back_the_positions(name):
    """A picture that holds each texel's position gives, looked up at any point of a face, that very point."""
    mesh = from_trimesh(SHAPES[name])
    atlas = atlas_of(mesh, 0.002, 512)
    picture = np.full((atlas.height * atlas.width, 3), np.nan)
    picture[atlas.texels] = texel_points(atlas, mesh)
    picture = picture.reshape(atlas.height, atlas.width, 3)
    rng = np.random.default_rng(3)
    faces = rng.integers(len(mesh.faces), size=400)
    weights = rng.dirichlet([1.0, 1.0, 1.0], size=400)
    uv = np.einsum("nc,ncd->nd", weights, atlas.corner_uv[faces])
    column = np.floor(uv[:, 0] * atlas.width).astype(int)
    row = np.floor((1.0 - uv[:, 1]) * atlas.height).astype(int)
    truth = np.einsum("nc,ncd->nd", weights, mesh.vertices[mesh.faces[faces]])
    sides = np.linalg.norm(np.diff(mesh.vertices[mesh.faces[faces]][:, [0, 1, 2, 0]], axis=1), axis=2).max(axis=1)
    # The nearest texel is at most a texel away; the smallest cell has two texels along a side.
    texels = np.maximum(sides / 2, 0.002 * 2)
    assert (np.linalg.norm(picture[row, column] - truth, axis=1) <= texels).all()


def test_more_faces_than_the_picture_can_hold_are_refused():
    mesh = from_trimesh(trimesh.creation.icosphere(4, 0.04))
    with pytest.raises(ValueError, match="do not fit"):
        atlas_of(mesh, 0.001, 64)
