"""Mesh files: deterministic text, pieces that are convex, thin ones left out."""

import numpy as np
import pytest
from simple_scenes import ball, box

from schemas.geometry import TriangleMesh
from tableverse_factory.errors import GeometryError
from tableverse_factory.geometry.meshes import read_mesh
from tableverse_factory.physics.assets import Appearance, obj_bytes, scaled, usable_hulls


@pytest.mark.parametrize("scale", [1e-4, 1.0, 100.0])
def test_an_obj_says_what_the_mesh_is(scale: float) -> None:
    mesh = scaled(ball(0.03), scale)
    back = read_mesh(obj_bytes(mesh), "ball.obj")
    np.testing.assert_array_equal(back.vertices, mesh.vertices)
    np.testing.assert_array_equal(back.faces, mesh.faces)
    np.testing.assert_allclose(mesh.vertices, ball(0.03).vertices * scale, atol=1e-7 * max(scale, 1e-2))


def test_no_minus_zero_and_no_exponent_reaches_the_file() -> None:
    mesh = TriangleMesh(
        np.array([[-1e-12, 0.0, 0.0], [0.1, 0.0, 0.0], [0.0, 0.1, 1e-9]]), np.array([[0, 1, 2]], dtype=np.int32)
    )
    text = obj_bytes(scaled(mesh, 1.0)).decode()
    assert "-0.0000000 " not in text
    assert "e-" not in text


def test_texture_points_stand_once_however_often_used() -> None:
    uv = np.tile([0.25, 0.75], (12, 3, 1))
    text = obj_bytes(scaled(box(0.1, 0.1, 0.1), 1.0), Appearance.at_corners(b"", uv)).decode()
    assert text.count("vt ") == 1
    assert "f 2/1 4/1 1/1\n" in text


def test_pieces_are_convex_after_rounding() -> None:
    (piece,) = usable_hulls((ball(0.03),), 0.3333)
    corners = piece.vertices[piece.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    heights = np.einsum("fk,vk->fv", normals, piece.vertices) - np.einsum("fk,fk->f", normals, corners[:, 0])[:, None]
    assert heights.max() < 1e-12


def test_thin_flat_and_empty_pieces_are_left_out() -> None:
    flat = TriangleMesh(
        np.array([[0.0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.1, 0.1, 0]]), np.zeros((0, 3), dtype=np.int32)
    )
    empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
    kept = usable_hulls((box(0.1, 0.1, 0.1), box(0.1, 0.1, 2e-5), flat, empty), 1.0)
    assert len(kept) == 1


def test_nothing_left_is_an_error_that_says_so() -> None:
    with pytest.raises(GeometryError, match="too small or too flat"):
        usable_hulls((box(3e-6, 3e-6, 3e-6),), 1.0)


def test_a_piece_with_too_many_vertices_is_refused() -> None:
    import trimesh

    from tableverse_factory.geometry.meshes import from_trimesh

    with pytest.raises(GeometryError, match="at most 64"):
        usable_hulls((from_trimesh(trimesh.creation.icosphere(2)),), 0.1)
