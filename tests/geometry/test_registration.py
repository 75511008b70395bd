import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.errors import GeometryError
from tableverse_factory.geometry.meshes import from_trimesh
from tableverse_factory.geometry.registration import median_distance, register, uncertainty_of
from tableverse_factory.geometry.samples import surface_samples
from tableverse_factory.geometry.symmetry import heading_folds
from tableverse_factory.geometry.transforms import (
    quaternion_about_z,
    rotation_angle,
    rotation_matrix,
    transform_points,
)

EYE = np.array([0.3, -0.7, 0.6])


def boot() -> TriangleMesh:
    """Nothing about it is symmetric but left and right."""
    sole = trimesh.creation.box((0.2, 0.07, 0.04))
    shaft = trimesh.creation.box((0.07, 0.06, 0.12), trimesh.transformations.translation_matrix((-0.06, 0, 0.08)))
    toe = trimesh.creation.icosphere(2, 0.03)
    toe.apply_translation((0.09, 0.0, 0.02))
    mesh = trimesh.util.concatenate([sole, shaft, toe])
    mesh.apply_translation((0, 0, 0.02))
    return from_trimesh(mesh)


def seen_points(mesh: TriangleMesh) -> np.ndarray:
    """Samples of the faces towards the eye, with a millimetre of noise."""
    points, triangle = surface_samples(mesh, 4000)
    a, b, c = (mesh.vertices[mesh.faces[triangle, k]] for k in range(3))
    towards = (np.cross(b - a, c - a) * (EYE - points)).sum(axis=1) > 0.0
    return points[towards] + np.random.default_rng(0).normal(0.0, 0.001, (int(towards.sum()), 3))


@pytest.mark.parametrize("yaw", [-2.8, -0.9, 0.0, 1.5, 3.0])
@pytest.mark.parametrize("unit", [1.0, 40.0])
def test_heading_position_and_size_come_back_whatever_the_unit_of_the_mesh(yaw: float, unit: float) -> None:
    mesh = boot()
    turn = rotation_matrix(quaternion_about_z(yaw))
    truth = TriangleMesh(mesh.vertices @ turn.T + np.array([0.1, 0.05, 0.0]), mesh.faces)
    found = register(TriangleMesh(mesh.vertices * unit, mesh.faces), seen_points(truth), EYE, 0.0)
    assert rotation_angle(found.pose.quaternion_wxyz, quaternion_about_z(yaw)) < np.deg2rad(3.0)
    ours = transform_points(found.pose, mesh.vertices * unit * found.size)
    np.testing.assert_allclose(ours.min(axis=0), truth.vertices.min(axis=0), atol=5e-3)
    np.testing.assert_allclose(ours.max(axis=0), truth.vertices.max(axis=0), atol=5e-3)
    assert found.residual_m < 0.002


def test_a_mesh_that_lies_on_its_side_is_turned_over() -> None:
    mesh = boot()
    tip = np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]])
    lying = mesh.vertices @ tip.T
    truth = TriangleMesh(lying - [0, 0, lying[:, 2].min()], mesh.faces)
    found = register(mesh, seen_points(truth), EYE, 0.0)
    ours = transform_points(found.pose, mesh.vertices * found.size)
    np.testing.assert_allclose(np.ptp(ours, axis=0), np.ptp(truth.vertices, axis=0), atol=8e-3)


def test_a_round_mesh_has_no_heading_to_find_and_still_fits() -> None:
    cylinder = trimesh.creation.cylinder(0.04, 0.1, sections=48)
    cylinder.apply_translation((0.02, 0.1, 0.05))
    truth = from_trimesh(cylinder)
    found = register(truth, seen_points(truth), EYE, 0.0)
    ours = transform_points(found.pose, truth.vertices * found.size)
    np.testing.assert_allclose(ours.min(axis=0), truth.vertices.min(axis=0), atol=4e-3)
    np.testing.assert_allclose(ours.max(axis=0), truth.vertices.max(axis=0), atol=4e-3)


def test_the_same_points_give_the_same_answer() -> None:
    points = seen_points(boot())
    first, second = register(boot(), points, EYE, 0.0), register(boot(), points, EYE, 0.0)
    np.testing.assert_array_equal(first.pose.position, second.pose.position)
    np.testing.assert_array_equal(first.size, second.size)


def test_too_few_points_and_a_mesh_without_extent_are_refused() -> None:
    with pytest.raises(GeometryError, match="3 points"):
        register(boot(), np.zeros((3, 3)), EYE, 0.0)
    point = TriangleMesh(np.zeros((3, 3)), np.array([[0, 1, 2]], dtype=np.int32))
    with pytest.raises(GeometryError, match="no extent"):
        register(point, seen_points(boot()), EYE, 0.0)


def test_the_residual_is_the_distance_to_the_surface() -> None:
    mesh = from_trimesh(trimesh.creation.box((0.2, 0.2, 0.2)))
    above = np.column_stack([np.random.default_rng(1).uniform(-0.09, 0.09, (200, 2)), np.full(200, 0.103)])
    assert median_distance(above, mesh) == pytest.approx(0.003, abs=1e-6)


def test_of_headings_that_look_alike_the_one_nearest_to_the_meshs_own_is_taken_and_said() -> None:
    box = from_trimesh(
        trimesh.creation.box((0.16, 0.09, 0.06), trimesh.transformations.translation_matrix((0, 0, 0.03)))
    )
    turn = rotation_matrix(quaternion_about_z(np.deg2rad(100.0)))
    found = register(box, seen_points(TriangleMesh(box.vertices @ turn.T, box.faces)), EYE, 0.0)
    assert found.uncertainty.heading_folds == 2
    assert np.rad2deg(rotation_angle(found.pose.quaternion_wxyz, quaternion_about_z(np.deg2rad(-80.0)))) < 3.0


def test_a_round_mesh_has_no_heading_and_a_handle_gives_it_one() -> None:
    cup = trimesh.creation.cylinder(0.04, 0.1, sections=48)
    handle = trimesh.creation.box((0.03, 0.012, 0.06), trimesh.transformations.translation_matrix((0.055, 0, 0)))
    round_one, mug = from_trimesh(cup), from_trimesh(trimesh.util.concatenate([cup, handle]))
    folds = []
    for mesh in (round_one, mug, from_trimesh(trimesh.creation.box((0.1, 0.1, 0.05)))):
        points, _ = surface_samples(mesh, 3000)
        folds.append(heading_folds(points, cKDTree(points)))
    assert folds == [0, 1, 4]
    sure = uncertainty_of(round_one, Pose(np.zeros(3), quaternion_about_z(0.0)), seen_points(round_one), -0.05)
    assert sure.heading_std_rad is None
    assert 0.0 < sure.position_std_m < 0.02


@pytest.mark.parametrize("thickness", [0.0, 0.0004])
def test_the_size_of_a_sheet_does_not_explode(thickness: float) -> None:
    sheet = from_trimesh(trimesh.creation.box((0.2, 0.12, 1.0)))
    sheet = TriangleMesh(sheet.vertices * [1.0, 1.0, thickness], sheet.faces)
    u, v = np.meshgrid(np.linspace(-0.1, 0.1, 60), np.linspace(-0.06, 0.06, 40))
    points = np.column_stack([u.ravel(), v.ravel(), np.full(u.size, 0.001)])
    points += np.random.default_rng(2).normal(0.0, 0.0005, points.shape)

    def emptiness(asked: np.ndarray) -> np.ndarray:
        """The camera sees past the sheet on all sides."""
        return np.minimum(0.1 - np.abs(asked[:, 0]), 0.06 - np.abs(asked[:, 1]))

    found = register(TriangleMesh(sheet.vertices * 7.0, sheet.faces), points, EYE, 0.0, emptiness=emptiness)
    extent = np.ptp(transform_points(found.pose, sheet.vertices * 7.0 * found.size), axis=0)
    np.testing.assert_allclose(np.sort(extent)[1:], [0.12, 0.2], rtol=0.1)


def test_what_less_is_seen_of_is_less_sure() -> None:
    mesh = boot()
    points = seen_points(mesh)
    whole = uncertainty_of(mesh, Pose(np.zeros(3), quaternion_about_z(0.0)), points, 0.0)
    corner = uncertainty_of(mesh, Pose(np.zeros(3), quaternion_about_z(0.0)), points[points[:, 0] > 0.08], 0.0)
    assert corner.position_std_m > whole.position_std_m
