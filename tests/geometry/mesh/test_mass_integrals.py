"""Volumes and centres of many small meshes at once are those of each by itself."""

import numpy as np
import pytest
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.mass_integrals import (
    compute_volumes_and_centers,
    encloses_volume,
    integrate_volume,
)
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tests.helpers.simple_scenes import ball, box

FLAT = TriangleMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 1]], dtype=np.int32))


def shifted(mesh: TriangleMesh, *by: float) -> TriangleMesh:
    return TriangleMesh(mesh.vertices + np.array(by), mesh.faces)


def test_each_is_as_by_itself() -> None:
    cone = from_trimesh(trimesh.creation.cone(0.03, 0.1))
    meshes = [shifted(box(0.1, 0.2, 0.3), 1.0, 2.0, 3.0), cone, FLAT, shifted(ball(0.03), -0.5, 0.0, 0.0)]
    volumes, centers = compute_volumes_and_centers(meshes, 1e-18)
    for k in (0, 1, 3):
        volume, center, _ = integrate_volume(meshes[k])
        assert volumes[k] == pytest.approx(volume, rel=1e-9)
        np.testing.assert_allclose(centers[k], center, atol=1e-12)
    assert volumes[2] == 1e-18
    np.testing.assert_allclose(centers[2], [1 / 3, 1 / 3, 0.0])


@pytest.mark.parametrize("place", [0, 1])
def test_a_mesh_without_a_face_is_refused(place: int) -> None:
    meshes = [box(0.1, 0.1, 0.1)]
    meshes.insert(place, TriangleMesh(FLAT.vertices, np.zeros((0, 3), dtype=np.int32)))
    with pytest.raises(ValueError, match="without a corner or a face"):
        compute_volumes_and_centers(meshes, 1e-18)


def test_moments_of_a_turned_box_are_those_of_the_formula() -> None:
    size = np.array([0.1, 0.2, 0.3])
    turn = trimesh.transformations.euler_matrix(0.3, 0.7, 1.1)[:3, :3]
    given = box(*size)
    volume, center, second = integrate_volume(TriangleMesh(given.vertices @ turn.T + 0.5, given.faces))
    assert volume == pytest.approx(0.006)
    np.testing.assert_allclose(center, [0.5, 0.5, 0.5])
    np.testing.assert_allclose(second, turn @ np.diag(0.006 * size**2 / 12) @ turn.T, atol=1e-12)


def test_open_scans_enclose_a_volume_and_sheets_and_inverted_solids_do_not() -> None:
    whole = box(0.1, 0.06, 0.03)
    far = TriangleMesh(whole.vertices + 5.0, whole.faces)
    assert encloses_volume(far)
    assert encloses_volume(TriangleMesh(far.vertices, whole.faces[2:])), "a side is missing"
    assert not encloses_volume(TriangleMesh(far.vertices, whole.faces[:, ::-1]))
    assert not encloses_volume(TriangleMesh(far.vertices, whole.faces[:1])), "one triangle alone"
    assert not encloses_volume(TriangleMesh(np.zeros((4, 3)), whole.faces[:2] % 4))
