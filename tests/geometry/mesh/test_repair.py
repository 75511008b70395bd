"""Bad meshes: each becomes a closed solid of the right size, or an error that says why."""

from collections.abc import Callable

import manifold3d
import numpy as np
import pytest
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.repair import make_closed_solid, solid_to_mesh

RADIUS = 0.05
BALL = from_trimesh(trimesh.creation.icosphere(subdivisions=3, radius=RADIUS))
VOLUME = float(trimesh.creation.icosphere(subdivisions=3, radius=RADIUS).volume)


def inside_out(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces[:, ::-1].copy())


def half_turned(mesh: TriangleMesh) -> TriangleMesh:
    faces = mesh.faces.copy()
    faces[::3] = faces[::3, ::-1]
    return TriangleMesh(mesh.vertices, faces)


def soup(mesh: TriangleMesh) -> TriangleMesh:
    faces = np.arange(3 * len(mesh.faces), dtype=np.int32).reshape(-1, 3)
    return TriangleMesh(mesh.vertices[mesh.faces].reshape(-1, 3), faces)


def with_holes(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, mesh.faces[15:])


def doubled(mesh: TriangleMesh) -> TriangleMesh:
    return TriangleMesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[:7]]))


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + int(start) for mesh, start in zip(meshes, starts, strict=True)]
    return TriangleMesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(faces).astype(np.int32))


def scaled(mesh: TriangleMesh, factor: float, shift: float = 0.0) -> TriangleMesh:
    return TriangleMesh(mesh.vertices * factor + shift, mesh.faces)


@pytest.mark.parametrize(
    ("spoil", "note"),
    [
        (lambda mesh: mesh, ""),
        (inside_out, ""),
        (soup, "merged"),
        (doubled, "merged"),
        (half_turned, "oriented"),
        (lambda mesh: soup(half_turned(mesh)), "oriented"),
        (with_holes, "filled"),
        (lambda mesh: inside_out(with_holes(mesh)), "filled"),
    ],
)
def test_a_spoilt_ball_has_the_volume_of_the_ball(spoil: Callable[[TriangleMesh], TriangleMesh], note: str) -> None:
    solid, repaired = make_closed_solid(spoil(BALL))
    assert repaired == note
    assert solid.volume() == pytest.approx(VOLUME, rel=2e-3)


@pytest.mark.parametrize("factor", [1e-6, 1.0, 800.0])
def test_size_does_not_matter(factor: float) -> None:
    solid, repaired = make_closed_solid(scaled(with_holes(BALL), factor))
    assert repaired == "filled"
    assert solid.volume() == pytest.approx(VOLUME * factor**3, rel=2e-3)


@pytest.mark.parametrize("other", [scaled(BALL, 0.5), inside_out(scaled(BALL, 0.5)), BALL])
def test_a_shell_within_the_shell_adds_nothing(other: TriangleMesh) -> None:
    assert make_closed_solid(joined(BALL, other))[0].volume() == pytest.approx(VOLUME, rel=1e-6)


def test_two_bodies_of_which_one_is_inside_out_count_both() -> None:
    solid, _ = make_closed_solid(joined(BALL, inside_out(scaled(BALL, 1.0, 0.2))))
    assert solid.volume() == pytest.approx(2 * VOLUME, rel=1e-6)


def test_overlapping_shells_count_their_union() -> None:
    box = from_trimesh(trimesh.creation.box((0.1, 0.1, 0.1)))
    moved = TriangleMesh(box.vertices + np.array([0.05, 0.0, 0.0]), box.faces)
    assert make_closed_solid(joined(box, moved))[0].volume() == pytest.approx(0.0015, rel=1e-9)


@pytest.mark.heavy
def test_an_open_bowl_of_one_sheet_becomes_a_bowl_and_no_dome() -> None:
    below = (BALL.vertices[BALL.faces][:, :, 2] < 1e-9).all(axis=1)
    solid, repaired = make_closed_solid(TriangleMesh(BALL.vertices, BALL.faces[below]))
    assert repaired == "remeshed"
    assert 0.01 * VOLUME < solid.volume() < 0.15 * VOLUME
    probe = manifold3d.Manifold.sphere(0.5 * RADIUS, 32).translate([0.0, 0.0, -0.3 * RADIUS])
    assert (solid ^ probe).volume() == 0.0


@pytest.mark.parametrize(
    "flat",
    [
        TriangleMesh(np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.0]]), np.array([[0, 1, 2]], dtype=np.int32)),
        TriangleMesh(
            np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0.0]]), np.array([[0, 1, 2], [0, 2, 1]], dtype=np.int32)
        ),
        from_trimesh(trimesh.creation.box((0.1, 0.1, 1e-9))),
    ],
)
def test_what_has_no_thickness_is_given_some(flat: TriangleMesh) -> None:
    solid, repaired = make_closed_solid(flat)
    assert repaired == "remeshed"
    assert solid_to_mesh(solid).vertices[:, 2] == pytest.approx(0.0, abs=0.001)
    assert solid.volume() > 1e-7 * 0.1**3


@pytest.mark.heavy
def test_the_remeshed_surface_lies_near_the_triangles() -> None:
    rng = np.random.default_rng(0)
    torn = soup(BALL)
    torn = TriangleMesh(torn.vertices + 1e-4 * rng.normal(size=torn.vertices.shape), torn.faces)
    solid, repaired = make_closed_solid(torn)
    assert repaired == "remeshed"
    radii = np.linalg.norm(solid_to_mesh(solid).vertices, axis=1)
    assert np.abs(radii - RADIUS).max() < 0.03 * RADIUS
    assert solid.volume() == pytest.approx(VOLUME, rel=0.06)


@pytest.mark.parametrize(
    ("mesh", "says"),
    [
        (TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32)), "no triangles"),
        (TriangleMesh(np.full((3, 3), np.nan), np.array([[0, 1, 2]], dtype=np.int32)), "NaN"),
        (TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 2]], dtype=np.int32)), "0 m large"),
        (TriangleMesh(np.eye(3), np.array([[0, 1, 7]], dtype=np.int32)), "missing vertices"),
        (TriangleMesh(np.diag([0.1, 0, 0]), np.array([[0, 1, 2]], dtype=np.int32)), "no surface"),
    ],
)
def test_what_is_no_surface_is_refused_with_the_reason(mesh: TriangleMesh, says: str) -> None:
    with pytest.raises(GeometryError, match=says):
        make_closed_solid(mesh)


@pytest.mark.heavy
def test_triangles_at_random_end_in_a_solid() -> None:
    rng = np.random.default_rng(1)
    mesh = TriangleMesh(rng.normal(size=(60, 3)), rng.integers(0, 60, (80, 3)).astype(np.int32))
    solid, repaired = make_closed_solid(mesh)
    assert repaired == "remeshed"
    assert solid.status() == manifold3d.Error.NoError
    assert solid.volume() > 0.0
