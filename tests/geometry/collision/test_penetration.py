"""Depths against what is known exactly: boxes, balls, disjoint things."""

import manifold3d
import numpy as np
import pytest
import trimesh

from schemas.geometry import ConvexPieces, Pose, TriangleMesh
from tableverse_factory.geometry.collision.penetration import measure_mesh_penetrations, measure_piece_penetrations
from tableverse_factory.geometry.math.transforms import quaternion_about_z
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.repair import solid_to_mesh


def box(*size: float) -> TriangleMesh:
    return from_trimesh(trimesh.creation.box(size))


def one_piece(mesh: TriangleMesh) -> ConvexPieces:
    return ConvexPieces((mesh,), 1.0, 0.0, "convex")


def at(x: float, y: float = 0.0, z: float = 0.0, angle: float = 0.0) -> Pose:
    return Pose(np.array([x, y, z]), quaternion_about_z(angle))


@pytest.mark.parametrize("depth", [1e-5, 1e-4, 1e-3, 0.01])
def test_two_boxes_overlap_by_what_they_were_pushed(depth: float) -> None:
    cube = box(0.1, 0.1, 0.1)
    poses = [at(0.0), at(0.1 - depth, 0.013, 0.007)]
    assert measure_piece_penetrations([one_piece(cube)] * 2, poses, [1.0, 1.0]) == [
        (0, 1, pytest.approx(depth, abs=1e-6))
    ]
    assert measure_mesh_penetrations([cube] * 2, poses, [1.0, 1.0]) == [(0, 1, pytest.approx(depth, abs=1e-7))]


def test_scale_and_rotation_are_applied_as_in_the_layout_format() -> None:
    cube = box(0.1, 0.1, 0.1)
    poses = [at(0.0, angle=np.pi / 4), at(0.17)]
    reach = 0.1 * np.sqrt(2) + 0.05 - 0.17  # corner of the first, scaled by 2, against a face of the second
    [(i, j, depth)] = measure_piece_penetrations([one_piece(cube)] * 2, poses, [2.0, 1.0])
    assert (i, j) == (0, 1)
    assert depth == pytest.approx(reach, abs=1e-6)
    [(_, _, shared)] = measure_mesh_penetrations([cube] * 2, poses, [2.0, 1.0])
    assert 0 < shared <= reach + 1e-9


def test_apart_is_no_pair() -> None:
    cube = box(0.1, 0.1, 0.1)
    poses = [at(0.0), at(0.1001), at(0.0, 0.0, 5.0)]
    assert measure_piece_penetrations([one_piece(cube)] * 3, poses, [1.0] * 3) == []
    assert measure_mesh_penetrations([cube] * 3, poses, [1.0] * 3) == []


def test_a_ball_swallowed_by_a_box_is_as_deep_as_the_ball() -> None:
    ball = from_trimesh(trimesh.creation.icosphere(subdivisions=3, radius=0.01))
    [(_, _, depth)] = measure_mesh_penetrations([ball, box(0.1, 0.1, 0.1)], [at(0.0), at(0.0)], [1.0, 1.0])
    assert depth == pytest.approx(0.02, rel=0.02)
    [(_, _, way_out)] = measure_piece_penetrations(
        [one_piece(ball), one_piece(box(0.1, 0.1, 0.1))], [at(0), at(0)], [1.0, 1.0]
    )
    assert way_out == pytest.approx(0.06, rel=0.02)


def test_two_rings_that_graze_are_not_as_deep_as_they_are_wide() -> None:
    ring = from_trimesh(trimesh.creation.annulus(r_min=0.03, r_max=0.035, height=0.04, sections=64))
    poses = [at(0.0), at(0.0)]
    [(_, _, depth)] = measure_mesh_penetrations([ring, ring], poses, [1.0, 0.86])
    assert depth < 3 * (0.86 * 0.035 - 0.03 * np.cos(np.pi / 64)) + 1e-9


def test_a_mesh_turned_inside_out_is_measured_all_the_same() -> None:
    cube = box(0.1, 0.1, 0.1)
    flipped = TriangleMesh(cube.vertices, cube.faces[:, ::-1].copy())
    [(_, _, depth)] = measure_mesh_penetrations([flipped, cube], [at(0.0), at(0.09)], [1.0, 1.0])
    assert depth == pytest.approx(0.01, abs=1e-7)


@pytest.mark.parametrize("film", [0.0, 1e-9, 1e-7, 1e-6, 1e-5, 1e-4, 3.2e-4, 5e-4])
@pytest.mark.parametrize("deep", [3e-4, 0.0026, 0.003])
def test_a_peg_is_as_deep_however_lightly_the_plate_around_it_touches(film: float, deep: float) -> None:
    plate = manifold3d.Manifold.cube([0.2, 0.2, 0.01], True)
    peg = manifold3d.Manifold.cube([0.004, 0.004, 0.01], True).translate([0.03, 0.02, -deep])
    table = box(0.8, 0.6, 0.04)
    poses = [at(0.0, 0.0, 0.005 - film), at(0.0, 0.0, -0.02)]
    [(_, _, depth)] = measure_mesh_penetrations([solid_to_mesh(plate + peg), table], poses, [1.0, 1.0])
    assert 0.85 * min(deep, 0.004 * 2 / 3) <= depth <= deep + film + 1e-9
