import numpy as np
import pytest
import trimesh
from scipy import ndimage
from scipy.spatial import cKDTree

from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.transforms import (
    quaternion_about_z,
    rotation_angle,
    transform_points,
)
from tableverse_factory.geometry.mesh.meshes import from_trimesh, place_mesh
from tableverse_factory.geometry.mesh.surface_samples import sample_surface
from tableverse_factory.geometry.registration.icp import PartialView
from tableverse_factory.geometry.registration.register import (
    STANDS_STD_M,
    estimate_uncertainty,
    measure_median_distance,
    register,
)
from tableverse_factory.geometry.registration.symmetry import count_heading_folds

EYE = np.array([0.3, -0.7, 0.6])
AT_ORIGIN = Pose(np.zeros(3), quaternion_about_z(0.0))
PIXEL = 0.004
"""Of the camera at a distance of 1."""


def boot() -> TriangleMesh:
    """Nothing about it is symmetric but left and right."""
    sole = trimesh.creation.box((0.2, 0.07, 0.04))
    shaft = trimesh.creation.box((0.07, 0.06, 0.12), trimesh.transformations.translation_matrix((-0.06, 0, 0.08)))
    toe = trimesh.creation.icosphere(1, 0.03)
    toe.apply_translation((0.09, 0.0, 0.02))
    mesh = trimesh.util.concatenate([sole, shaft, toe])
    mesh.apply_translation((0, 0, 0.02))
    return from_trimesh(mesh)


def sheet(thickness: float = 0.0) -> TriangleMesh:
    box = from_trimesh(trimesh.creation.box((0.2, 0.12, 1.0)))
    return TriangleMesh(box.vertices * [1.0, 1.0, thickness], box.faces)


def line(vertices: np.ndarray) -> np.ndarray:
    """The same without breadth."""
    return vertices * [1.0, 0.0, 0.0]


def view_of(mesh: TriangleMesh, noise_m: float = 0.001, every: int = 1) -> PartialView:
    """Samples of the faces towards the eye, and the rays that pass the mesh."""
    points, triangle = sample_surface(mesh, 4000)
    a, b, c = (mesh.vertices[mesh.faces[triangle, k]] for k in range(3))
    towards = (np.cross(b - a, c - a) * (EYE - points)).sum(axis=1) > 0.0
    away = -EYE / np.linalg.norm(EYE)
    right = np.cross(away, [0.0, 0.0, 1.0]) / np.linalg.norm(np.cross(away, [0.0, 0.0, 1.0]))

    def pixels(asked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        rays = asked - EYE
        distance = np.maximum(rays @ away, 1e-3)
        across = np.stack([rays @ right, rays @ np.cross(away, right)]) / distance
        return np.clip(across / PIXEL + 100.0, 0, 199), distance

    own = np.zeros((200, 200), dtype=bool)
    own[tuple(np.rint(pixels(points)[0]).astype(int))] = True
    own = ndimage.binary_closing(own, iterations=2)
    outline = ndimage.distance_transform_edt(own) - ndimage.distance_transform_edt(~own)

    def emptiness(asked: np.ndarray) -> np.ndarray:
        where, distance = pixels(asked)
        return ndimage.map_coordinates(outline, where, order=1) * PIXEL * distance

    seen = points[towards][::every]
    noisy = seen + np.random.default_rng(0).normal(0.0, noise_m, seen.shape)
    return PartialView(noisy, EYE, float(mesh.vertices[:, 2].min()), STANDS_STD_M, emptiness)


def turned(mesh: TriangleMesh, degrees: float, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> TriangleMesh:
    return place_mesh(mesh, Pose(np.array(shift), quaternion_about_z(np.deg2rad(degrees))))


def placed(mesh: TriangleMesh, view: PartialView) -> np.ndarray:
    """The vertices of the mesh where it is registered."""
    found = register(mesh, view)
    return transform_points(found.pose, mesh.vertices * found.size)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("degrees", "unit"),
    [
        (-50.0, 40.0),
        (172.0, 1.0),
        *(pytest.param(*more, marks=pytest.mark.slow) for more in ((-160.0, 1.0), (0.0, 1e-6), (85.0, 1e6))),
    ],
)
def test_heading_position_and_size_come_back_whatever_the_unit_of_the_mesh(degrees: float, unit: float) -> None:
    mesh = boot()
    truth = turned(mesh, degrees, (0.1, 0.05, 0.0))
    found = register(TriangleMesh(mesh.vertices * unit, mesh.faces), view_of(truth))
    heading = quaternion_about_z(np.deg2rad(degrees))
    assert rotation_angle(found.pose.quaternion_wxyz, heading) < np.deg2rad(3.0)
    np.testing.assert_allclose(
        transform_points(found.pose, mesh.vertices * unit * found.size), truth.vertices, atol=0.01
    )
    assert found.uncertainty.position_std_m < 0.005


@pytest.mark.heavy
def test_a_mesh_that_lies_on_its_side_is_turned_over() -> None:
    mesh = boot()
    lying = mesh.vertices @ np.array([[1.0, 0, 0], [0, 0, -1.0], [0, 1.0, 0]]).T
    truth = TriangleMesh(lying - [0, 0, lying[:, 2].min()], mesh.faces)
    np.testing.assert_allclose(np.ptp(placed(mesh, view_of(truth)), axis=0), np.ptp(truth.vertices, axis=0), atol=8e-3)


@pytest.mark.heavy
def test_a_round_mesh_has_no_heading_to_find_and_still_fits() -> None:
    cylinder = trimesh.creation.cylinder(0.04, 0.1, sections=24)
    cylinder.apply_translation((0.02, 0.1, 0.05))
    truth = from_trimesh(cylinder)
    ours = placed(truth, view_of(truth))
    np.testing.assert_allclose(ours.min(axis=0), truth.vertices.min(axis=0), atol=5e-3)
    np.testing.assert_allclose(ours.max(axis=0), truth.vertices.max(axis=0), atol=5e-3)


@pytest.mark.heavy
def test_the_same_view_gives_the_same_answer() -> None:
    view = view_of(boot(), every=4)
    np.testing.assert_array_equal(placed(boot(), view), placed(boot(), view))


@pytest.mark.heavy
def test_of_headings_that_look_alike_the_one_nearest_to_the_meshs_own_is_taken_and_said() -> None:
    box = from_trimesh(
        trimesh.creation.box((0.16, 0.09, 0.06), trimesh.transformations.translation_matrix((0, 0, 0.03)))
    )
    found = register(box, view_of(turned(box, 100.0)))
    assert found.uncertainty.heading_folds == 2
    assert np.rad2deg(rotation_angle(found.pose.quaternion_wxyz, quaternion_about_z(np.deg2rad(-80.0)))) < 3.0


@pytest.mark.parametrize("thickness", [0.0, 0.0004])
def test_the_size_of_a_sheet_does_not_explode(thickness: float) -> None:
    thin = sheet(thickness)
    ours = placed(TriangleMesh(thin.vertices * 7.0, thin.faces), view_of(thin, noise_m=0.0005))
    assert np.ptp(ours, axis=0)[2] < 0.01
    np.testing.assert_allclose(np.sort(np.ptp(ours, axis=0))[1:], [0.12, 0.2], rtol=0.1)


def test_a_single_triangle_comes_back() -> None:
    corners = np.array([[0.0, 0.0, 0.0], [0.15, 0.0, 0.0], [0.0, 0.1, 0.0]])
    mesh = TriangleMesh(corners, np.array([[0, 1, 2]], dtype=np.int32))
    truth = turned(mesh, 20.0)
    np.testing.assert_allclose(placed(mesh, view_of(truth)), truth.vertices, atol=0.012)


def test_ten_points_give_a_placement_near_them() -> None:
    view = view_of(boot())
    few = PartialView(view.points[:: len(view.points) // 10][:10], EYE, 0.0, STANDS_STD_M, view.emptiness)
    ours = placed(boot(), few)
    np.testing.assert_allclose(ours.mean(axis=0), boot().vertices.mean(axis=0), atol=0.06)
    np.testing.assert_allclose(np.ptp(ours, axis=0).max(), 0.2, rtol=0.5)


@pytest.mark.parametrize(
    ("points", "vertices", "why"),
    [
        (lambda p: p[:9], lambda v: v, "9 points"),
        (line, lambda v: v, "lie on a line"),
        (np.zeros_like, lambda v: v, "lie on a line"),
        (lambda p: np.where(p == p[5], np.nan, p), lambda v: v, "not finite"),
        (lambda p: p, lambda v: np.where(v == v[5], np.inf, v), "not finite"),
        (lambda p: p, np.zeros_like, "no surface"),
        (lambda p: p, line, "no surface"),
    ],
)
def test_what_has_no_answer_is_refused(points, vertices, why: str) -> None:
    mesh, view = boot(), view_of(boot())
    with pytest.raises(GeometryError, match=why):
        register(
            TriangleMesh(vertices(mesh.vertices), mesh.faces),
            PartialView(points(view.points), EYE, 0.0, STANDS_STD_M, view.emptiness),
        )


def test_the_residual_is_the_distance_to_the_surface() -> None:
    mesh = from_trimesh(trimesh.creation.box((0.2, 0.2, 0.2)))
    above = np.column_stack([np.random.default_rng(1).uniform(-0.09, 0.09, (200, 2)), np.full(200, 0.103)])
    assert measure_median_distance(above, mesh) == pytest.approx(0.003, abs=1e-6)


def test_a_round_mesh_has_no_heading_and_a_handle_gives_it_one() -> None:
    cup = trimesh.creation.cylinder(0.04, 0.1, sections=24)
    handle = trimesh.creation.box((0.03, 0.012, 0.06), trimesh.transformations.translation_matrix((0.055, 0, 0)))
    round_one, mug = from_trimesh(cup), from_trimesh(trimesh.util.concatenate([cup, handle]))
    folds = []
    for mesh in (round_one, mug, from_trimesh(trimesh.creation.box((0.1, 0.1, 0.05)))):
        points, _ = sample_surface(mesh, 3000)
        folds.append(count_heading_folds(points, cKDTree(points)))
    assert folds == [0, 1, 4]
    sure = estimate_uncertainty(round_one, AT_ORIGIN, view_of(round_one))
    assert sure.heading_std_rad is None
    assert 0.0 < sure.position_std_m < 0.02


def test_what_less_is_seen_of_is_less_sure() -> None:
    mesh, whole = boot(), view_of(boot())
    corner = PartialView(whole.points[whole.points[:, 0] > 0.08], EYE, 0.0, STANDS_STD_M, whole.emptiness)
    assert (
        estimate_uncertainty(mesh, AT_ORIGIN, corner).position_std_m
        > estimate_uncertainty(mesh, AT_ORIGIN, whole).position_std_m
    )
