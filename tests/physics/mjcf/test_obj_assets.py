"""Mesh files: deterministic text, pieces that are convex, thin ones left out."""

import numpy as np
import pytest
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume
from tableverse_factory.geometry.mesh.meshes import from_trimesh, read_mesh
from tableverse_factory.physics.mjcf.obj_assets import (
    ROUNDING_UNITS,
    Appearance,
    count_decimals,
    encode_obj,
    prepare_hulls,
    scale_and_quantize,
)
from tests.helpers.simple_scenes import ball, box


@pytest.mark.parametrize("scale", [1e-4, 1.0, 100.0])
def test_an_obj_says_what_the_mesh_is(scale: float) -> None:
    mesh = scale_and_quantize(ball(0.03), scale)
    back = read_mesh(encode_obj(mesh), "ball.obj")
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_allclose(mesh.vertices, ball(0.03).vertices * scale, atol=1e-7 * max(scale, 1e-2))


def test_no_minus_zero_and_no_exponent_reaches_the_file() -> None:
    mesh = TriangleMesh(
        np.array([[-1e-12, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 1e-9]]), np.array([[0, 1, 2]], dtype=np.int32)
    )
    text = encode_obj(scale_and_quantize(mesh, 1.0)).decode()
    assert "-0.0000000 " not in text
    assert "e-" not in text


def test_texture_points_stand_once_however_often_used() -> None:
    uv = np.tile([0.25, 0.75], (12, 3, 1))
    text = encode_obj(scale_and_quantize(box(0.1, 0.1, 0.1), 1.0), Appearance.at_corners(b"", uv)).decode()
    assert text.count("vt ") == 1
    assert "f 2/1 4/1 1/1\n" in text


def dent(piece: TriangleMesh) -> float:
    """How far a corner stands out over the plane of a face, at most [m]."""
    corners = piece.vertices[piece.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    heights = np.einsum("fk,vk->fv", normals, piece.vertices) - np.einsum("fk,fk->f", normals, corners[:, 0])[:, None]
    return float(heights.max())


@pytest.mark.parametrize("scale", [0.01, 0.3333, 1.0, 3.0])
def test_pieces_are_convex_to_the_last_digits_after_rounding(scale: float) -> None:
    turned = box(0.02, 0.05, 0.07).vertices @ trimesh.transformations.euler_matrix(0.3, 0.7, 1.1)[:3, :3].T
    (round_one, edged) = prepare_hulls((ball(0.03), TriangleMesh(turned, box(0.02, 0.05, 0.07).faces)), scale)
    for piece in (round_one, edged):
        assert dent(piece) <= ROUNDING_UNITS * 10.0 ** -count_decimals(piece.vertices)
    assert compute_signed_volume(edged) == pytest.approx(7e-5 * scale**3, rel=1e-3)


def test_a_dented_piece_and_one_inside_out_become_their_hulls() -> None:
    cube = from_trimesh(trimesh.creation.box((0.1, 0.1, 0.1)).subdivide())
    middles = np.flatnonzero(np.isclose(np.abs(cube.vertices).sum(axis=1), 0.05))
    vertices = cube.vertices.copy()
    vertices[middles[0]] *= 0.9
    for given in (TriangleMesh(vertices, cube.faces), TriangleMesh(cube.vertices, cube.faces[:, ::-1].copy())):
        (piece,) = prepare_hulls((given,), 1.0)
        assert dent(piece) < 1e-9
        assert compute_signed_volume(piece) == pytest.approx(1e-3, rel=1e-6)


def test_thin_flat_and_empty_pieces_are_left_out() -> None:
    flat = TriangleMesh(
        np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]]), np.zeros((0, 3), dtype=np.int32)
    )
    empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
    kept = prepare_hulls((box(0.1, 0.1, 0.1), box(0.1, 0.1, 2e-5), flat, empty), 1.0)
    assert len(kept) == 1


def test_nothing_left_is_an_error_that_says_so() -> None:
    with pytest.raises(GeometryError, match="too small or too flat"):
        prepare_hulls((box(3e-6, 3e-6, 3e-6),), 1.0)


def test_a_piece_with_too_many_vertices_is_refused() -> None:
    with pytest.raises(GeometryError, match="at most 64"):
        prepare_hulls((from_trimesh(trimesh.creation.icosphere(2)),), 0.1)
