"""Convex pieces: that they cover, that cavities stay open, that cache and scale leave no trace."""

from pathlib import Path

import manifold3d
import numpy as np
import pytest
import trimesh

from schemas.codec import encode
from schemas.config import RectifyConfig
from schemas.geometry import ConvexPieces, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.convex import cut_and_merge
from tableverse_factory.geometry.convex.bounded_pieces import HULL_TOLERANCE, MAX_HULL_VERTICES
from tableverse_factory.geometry.convex.decompose import decompose
from tableverse_factory.geometry.convex.metrics import measure_distance_to_pieces
from tableverse_factory.geometry.mesh.hulls import make_bounded_hull, make_hull, make_hull_mesh, measure_protrusion
from tableverse_factory.geometry.mesh.mass_integrals import compute_signed_volume
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.repair import mesh_to_solid, solid_to_mesh

CONFIG = RectifyConfig()


def bowl(radius: float = 0.08, wall: float = 0.003) -> TriangleMesh:
    outer, inner = manifold3d.Manifold.sphere(radius, 48), manifold3d.Manifold.sphere(radius - wall, 48)
    return solid_to_mesh((outer - inner).trim_by_plane([0, 0, -1], 0.0))


def cup() -> TriangleMesh:
    outer = manifold3d.Manifold.cylinder(0.1, 0.04, 0.04, 48)
    inner = manifold3d.Manifold.cylinder(0.1, 0.035, 0.035, 48).translate([0, 0, 0.005])
    handle = manifold3d.Manifold.cube([0.03, 0.01, 0.06]).translate([0.036, -0.005, 0.02])
    hole = manifold3d.Manifold.cube([0.02, 0.02, 0.04]).translate([0.04, -0.01, 0.03])
    return solid_to_mesh((outer + handle - hole) - inner)


def l_shape() -> TriangleMesh:
    return solid_to_mesh(
        manifold3d.Manifold.cube([0.2, 0.05, 0.05]) + manifold3d.Manifold.cube([0.05, 0.05, 0.2]).translate([0, 0, 0])
    )


def filled(pieces: ConvexPieces) -> manifold3d.Manifold:
    return manifold3d.Manifold.batch_boolean([make_hull(hull.vertices) for hull in pieces.hulls], manifold3d.OpType.Add)


@pytest.fixture(scope="module")
def bowl_pieces(tmp_path_factory: pytest.TempPathFactory) -> ConvexPieces:
    return decompose(bowl(), CONFIG, tmp_path_factory.mktemp("cache"))


@pytest.mark.heavy
def test_a_bowl_keeps_its_cavity(bowl_pieces: ConvexPieces) -> None:
    probe = manifold3d.Manifold.sphere(0.055, 48).translate([0, 0, -0.012])
    assert (filled(bowl_pieces) ^ probe).volume() == 0.0
    assert bowl_pieces.cavity_kept > 0.9
    assert bowl_pieces.method == "cut"
    assert len(bowl_pieces.hulls) <= CONFIG.max_pieces


@pytest.mark.heavy
def test_a_cup_keeps_its_cavity_and_its_handle_some_room(tmp_path: Path) -> None:
    pieces = decompose(cup(), CONFIG, tmp_path)
    water = manifold3d.Manifold.cylinder(0.09, 0.031, 0.031, 48).translate([0, 0, 0.012])
    assert (filled(pieces) ^ water).volume() < 1e-3 * water.volume()
    finger = manifold3d.Manifold.sphere(0.004, 24).translate([0.05, 0.0, 0.05])
    assert (filled(pieces) ^ finger).volume() == 0.0


def test_two_boxes_at_a_right_angle_are_two_pieces(tmp_path: Path) -> None:
    pieces = decompose(l_shape(), CONFIG, tmp_path)
    assert len(pieces.hulls) == 2
    assert 1.0 - 1e-9 <= pieces.volume_ratio <= 1.0 + CONFIG.volume_error
    assert pieces.uncovered_m < 1e-9
    assert pieces.cavity_kept > 0.9


@pytest.mark.parametrize("shape", [trimesh.creation.box((0.1, 0.2, 0.3)), trimesh.creation.icosphere(3, 0.05)])
def test_what_is_convex_is_one_piece_without_a_search(shape: trimesh.Trimesh, tmp_path: Path) -> None:
    pieces = decompose(from_trimesh(shape), CONFIG, tmp_path)
    assert (pieces.method, len(pieces.hulls)) == ("convex", 1)
    assert pieces.volume_ratio == pytest.approx(1.0, abs=0.13)
    assert pieces.uncovered_m < 1e-4


@pytest.mark.heavy
@pytest.mark.parametrize("make", [bowl, pytest.param(cup, marks=pytest.mark.slow), l_shape])
def test_pieces_are_convex_closed_small_and_cover_the_mesh(make: type, tmp_path: Path) -> None:
    mesh = make()
    pieces = decompose(mesh, CONFIG, tmp_path)
    for hull in pieces.hulls:
        assert len(hull.vertices) <= MAX_HULL_VERTICES
        assert mesh_to_solid(hull).volume() == pytest.approx(compute_signed_volume(hull))
        assert compute_signed_volume(hull) > 0.0
        assert measure_protrusion(hull, hull.vertices)[0].max() < 1e-9
    # Hulls of the cut parts cover the mesh, and a piece comes this near to all corners of its part, whatever the cuts.
    allowed = HULL_TOLERANCE * float(np.ptp(mesh.vertices, axis=0).max()) + 1e-9
    corners = mesh.vertices[mesh.faces]
    for weights in ([1, 0, 0], [0.5, 0.5, 0], [1 / 3, 1 / 3, 1 / 3]):
        points = np.einsum("nij,i->nj", corners, np.array(weights, dtype=float))
        assert measure_distance_to_pieces(points, pieces.hulls).max() <= allowed
    assert pieces.uncovered_m <= allowed
    assert pieces.volume_ratio == pytest.approx(filled(pieces).volume() / mesh_to_solid(mesh).volume(), rel=1e-6)


@pytest.mark.heavy
def test_a_warm_cache_gives_the_bytes_of_a_cold_one(tmp_path: Path) -> None:
    cold = encode(decompose(cup(), CONFIG, tmp_path / "a"))
    assert encode(decompose(cup(), CONFIG, tmp_path / "a")) == cold
    assert encode(decompose(cup(), CONFIG, tmp_path / "b")) == cold


@pytest.mark.heavy
def test_a_damaged_or_foreign_cache_file_is_no_answer(tmp_path: Path) -> None:
    expected = encode(decompose(l_shape(), CONFIG, tmp_path))
    [path] = tmp_path.rglob("*.arrow")
    whole = path.read_bytes()
    for damage in (whole[:-9], b"", whole[:200] + b"x" + whole[201:], b"nonsense"):
        path.write_bytes(damage)
        assert encode(decompose(l_shape(), CONFIG, tmp_path)) == expected
        assert path.read_bytes() == whole
    assert not list(tmp_path.rglob("*.part"))


def test_the_cache_knows_shape_and_not_scale_or_place(tmp_path: Path) -> None:
    mesh = l_shape()
    pieces = decompose(mesh, CONFIG, tmp_path)
    larger = decompose(TriangleMesh(4.0 * mesh.vertices + [1.0, 2.0, 4.0], mesh.faces), CONFIG, tmp_path)
    assert len(list(tmp_path.rglob("*.arrow"))) == 1
    for hull, other in zip(pieces.hulls, larger.hulls, strict=True):
        assert other.vertices == pytest.approx(4.0 * hull.vertices + [1.0, 2.0, 4.0], abs=1e-9)
    assert larger.hausdorff_m == pytest.approx(4.0 * pieces.hausdorff_m)
    assert larger.volume_ratio == pieces.volume_ratio


def test_other_parameters_are_another_entry(tmp_path: Path) -> None:
    few = CONFIG.model_copy(update={"max_pieces": 1})
    assert len(decompose(l_shape(), CONFIG, tmp_path).hulls) == 2
    assert len(decompose(l_shape(), few, tmp_path).hulls) == 1


@pytest.mark.heavy
def test_a_budget_is_kept(tmp_path: Path) -> None:
    pieces = decompose(bowl(), CONFIG.model_copy(update={"max_pieces": 7}), tmp_path)
    assert len(pieces.hulls) <= 7


@pytest.mark.parametrize("factor", [3e-5, 250.0])
def test_tiny_and_huge_are_as_good_as_any(factor: float, tmp_path: Path) -> None:
    mesh = l_shape()
    pieces = decompose(TriangleMesh(mesh.vertices * factor, mesh.faces), CONFIG, tmp_path)
    assert len(pieces.hulls) == 2
    assert 1.0 - 1e-9 <= pieces.volume_ratio <= 1.0 + CONFIG.volume_error


def test_repairs_are_recorded(tmp_path: Path) -> None:
    mesh = l_shape()
    torn = TriangleMesh(
        mesh.vertices[mesh.faces].reshape(-1, 3), np.arange(3 * len(mesh.faces), dtype=np.int32).reshape(-1, 3)
    )
    pieces = decompose(torn, CONFIG, tmp_path)
    assert pieces.repaired == "merged"
    assert len(pieces.hulls) == 2


def test_hopeless_meshes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(GeometryError):
        decompose(TriangleMesh(np.full((3, 3), np.inf), np.array([[0, 1, 2]], dtype=np.int32)), CONFIG, tmp_path)
    assert not list(tmp_path.rglob("*.arrow"))


@pytest.mark.parametrize("limit", [16, 32, 64])
def test_a_bounded_hull_covers_what_it_stands_for(limit: int) -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(size=(800, 3)) * [1.0, 0.6, 0.2]
    hull = make_bounded_hull(points, limit, 1e-3)
    assert len(hull.vertices) <= limit
    reach = float(np.ptp(points, axis=0).max())
    assert measure_protrusion(hull, points)[0].max() < 0.03 * reach
    assert compute_signed_volume(hull) < 2.2 * compute_signed_volume(make_hull_mesh(points))


def test_few_points_are_their_own_hull() -> None:
    points = np.array([[x, y, z] for x in (0.0, 1.0) for y in (0.0, 1.0) for z in (0.0, 1.0)])
    assert sorted(map(tuple, make_bounded_hull(points, 64, 1e-4).vertices)) == sorted(map(tuple, points))


def test_coplanar_points_span_no_volume() -> None:
    with pytest.raises(GeometryError, match="no volume"):
        make_bounded_hull(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]), 64, 1e-4)


@pytest.mark.heavy
def test_coacd_is_an_option_and_its_pieces_are_another_cache_entry(tmp_path):
    corner = trimesh.util.concatenate(
        [
            trimesh.creation.box(bounds=[[0, 0, 0], [0.2, 0.05, 0.05]]),
            trimesh.creation.box(bounds=[[0, 0, 0], [0.05, 0.2, 0.05]]),
        ]
    )
    mesh = from_trimesh(corner)
    cut = decompose(mesh, RectifyConfig(), tmp_path)
    searched = decompose(mesh, RectifyConfig(decomposition="coacd"), tmp_path)
    again = decompose(mesh, RectifyConfig(decomposition="coacd"), tmp_path / "cold")
    assert (cut.method, searched.method) == ("cut", "coacd")
    assert encode(searched) == encode(again)
    assert searched.volume_ratio == pytest.approx(1.0, abs=0.06)
    assert len(searched.hulls) == 2


@pytest.mark.heavy
def test_few_vertices_do_not_cost_more_volume_than_is_allowed(tmp_path: Path) -> None:
    """Rods across one another: hulls of 64 vertices around round things add some percent each."""
    rod = manifold3d.Manifold.cylinder(0.2, 0.01, 0.01, 96).translate([0, 0, -0.1])
    mesh = solid_to_mesh(rod + rod.rotate([90, 0, 0]) + rod.rotate([0, 90, 0]).translate([0, 0, 0.05]))
    pieces = decompose(mesh, CONFIG, tmp_path)
    assert pieces.volume_ratio <= 1.0 + CONFIG.volume_error or len(pieces.hulls) == CONFIG.max_pieces


@pytest.mark.heavy
def test_hulls_of_thin_patches_are_convex_and_have_no_thorns() -> None:
    """Parts of a shell, where manifold3d's own hull may go wrong."""
    outer, inner = (mesh_to_solid(from_trimesh(trimesh.creation.icosphere(4, radius))) for radius in (0.5, 0.48))
    shell = (outer - inner).trim_by_plane([0, 0, -1], 0.0)
    for part in cut_and_merge._cut(shell, 72, 1e-3, 1e-9):
        hull = make_hull_mesh(part.points)
        assert measure_protrusion(hull, part.points)[0].max() < 1e-9
        assert measure_protrusion(hull, make_bounded_hull(part.points, 64, 4e-4).vertices)[0].max() < 0.005
