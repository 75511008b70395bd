"""Inflation: bodies with symmetric sections get their thickness back, and what the picture proves stays true."""

import numpy as np
import pytest
import trimesh
from manifold3d import CrossSection

from schemas.geometry import TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.evaluation.bench.completion import (
    render_noisy_view,
    score_completion,
    stand_on_table,
)
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.geometry.mesh.meshes import from_trimesh, place_mesh
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene, pack_rays, to_tensor
from tableverse_factory.geometry.mesh.voxel_solids import to_manifold
from tableverse_factory.stages.place.completion.inflation import estimate_thickness, inflate
from tableverse_factory.stages.place.completion.voxel_carving import carve_columns
from tableverse_factory.stages.place.view.object_view import ObjectView, measure_free_space, view_object
from tableverse_factory.stages.place.view.support_from_depth import find_supports


def lie(shape: trimesh.Trimesh, *, raised_m: float = 0.0) -> TriangleMesh:
    shape.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0.0, 1.0, 0.0]))
    mesh = stand_on_table(from_trimesh(shape))
    return TriangleMesh(mesh.vertices + np.array([0.0, 0.0, raised_m]), mesh.faces)


def look(mesh: TriangleMesh, elevation: float = 0.8, noise_m: float = 0.001) -> ObjectView:
    scene = render_noisy_view([mesh], 0.7, elevation, np.random.default_rng(3), noise_m)
    return view_object(
        scene, scene.objects[0], find_supports(scene.objects, scene.camera_to_table)[scene.objects[0].object_id]
    )


def measure_true_thickness(mesh: TriangleMesh, view: ObjectView) -> np.ndarray:
    unit = backproject(np.ones(view.own.shape), view.camera)[view.own]
    directions = unit @ rotation_matrix(view.camera_to_table.quaternion_wxyz).T
    scene = make_raycasting_scene(mesh)
    there = scene.cast_rays(pack_rays(view.eye, directions), nthreads=1)["t_hit"].numpy()
    back = scene.cast_rays(pack_rays(view.eye + 2.0 * directions, -directions), nthreads=1)["t_hit"].numpy()
    return 2.0 - back - there


@pytest.mark.parametrize("radius", [0.006, 0.02])
def test_a_lying_bar_is_as_thick_as_it_is_wide(radius):
    mesh = lie(trimesh.creation.capsule(0.12, radius), raised_m=0.02)
    view = look(mesh)
    truth = measure_true_thickness(mesh, view)
    core = np.isfinite(truth) & (truth > 1.5 * radius)
    found = np.median(estimate_thickness(view)[1][view.own][core])
    assert abs(found / np.median(truth[core]) - 1.0) < 0.25


SHAPES = {"bar": lambda: trimesh.creation.capsule(0.12, 0.018), "ball": lambda: trimesh.creation.icosphere(3, 0.03)}


@pytest.mark.parametrize("name", SHAPES)
def test_what_stands_behind_the_silhouette_is_completed_better_than_by_columns(name):
    mesh = lie(SHAPES[name]())
    view = look(mesh)
    scores = [
        score_completion(name, 0, name, mesh, place_mesh(carved.simplify(), carved.pose)).iou
        for carved in (inflate(view), carve_columns(view))
    ]
    assert scores[0] > max(0.8, scores[1] + 0.05)


@pytest.mark.parametrize("elevation", [0.6, 0.8, 1.0])
@pytest.mark.parametrize("thickness", [0.003, 0.005])
def test_a_raised_flat_thing_has_about_the_volume_that_it_has(thickness, elevation):
    lying = stand_on_table(from_trimesh(trimesh.creation.box((0.1, 0.06, thickness))))
    view = look(TriangleMesh(lying.vertices + np.array([0.0, 0.0, 0.016]), lying.faces), elevation)
    found = inflate(view).simplify()
    volume = trimesh.Trimesh(found.vertices, found.faces).volume
    assert 0.75 < volume / (0.1 * 0.06 * thickness) < 1.25


@pytest.mark.parametrize("name", SHAPES)
def test_no_free_space_is_filled_and_no_seen_surface_carved(name):
    view = look(lie(SHAPES[name]()), noise_m=0.0)
    carved = inflate(view)
    whole = place_mesh(carved.mesh, carved.pose)
    # Between a pixel and the next at the silhouette the distance to free space jumps.
    assert np.quantile(measure_free_space(view, whole.vertices), 0.01) > -carved.cell
    away = make_raycasting_scene(whole).compute_distance(to_tensor(view.points), nthreads=1).numpy()
    assert np.quantile(away, 0.98) < carved.cell


def test_the_same_view_gives_the_same_bytes():
    view = look(lie(SHAPES["bar"]()))
    one, two = inflate(view), inflate(view)
    assert one.stretched.vertices.tobytes() == two.stretched.vertices.tobytes()


def test_without_a_silhouette_nothing_is_inflated():
    view = look(lie(SHAPES["bar"]()))
    hidden = ObjectView(**{name: getattr(view, name) for name in view.__slots__} | {"past": np.zeros_like(view.past)})
    with pytest.raises(GeometryError, match="silhouette"):
        estimate_thickness(hidden)


@pytest.mark.parametrize("carve", [carve_columns, inflate])
def test_a_floor_that_was_seen_no_higher_than_the_table_has_no_hole(carve):
    profile = [[0.0, 0.0], [0.03, 0.0], [0.06, 0.04], [0.056, 0.04], [0.028, 0.0004], [0.0, 0.0004]]
    carved = carve(look(stand_on_table(from_trimesh(trimesh.creation.revolve(profile))), 0.9))
    at_floor = to_manifold(carved.simplify()).slice(0.001 - carved.pose.position[2])
    true_floor = CrossSection.circle(0.024, 64).translate(-carved.pose.position[:2])
    assert (at_floor ^ true_floor).area() > 0.98 * true_floor.area()


@pytest.mark.parametrize("carve", [carve_columns, inflate])
def test_a_hole_that_shows_the_table_stays_open(carve):
    ring = stand_on_table(from_trimesh(trimesh.creation.annulus(0.006, 0.025, 0.01)))
    carved = carve(look(ring, 1.3))
    assert to_manifold(carved.simplify()).genus() == 1
