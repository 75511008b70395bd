import numpy as np
import pytest
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.errors import GeometryError
from tableverse_factory.geometry.meshes import from_trimesh
from tableverse_factory.geometry.registration import median_distance, register
from tableverse_factory.geometry.samples import surface_samples
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
