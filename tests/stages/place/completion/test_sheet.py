"""Sheets of one thickness: an oval dish is no solid, and a block with a hollow on top is no sheet."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from schemas.geometry import TriangleMesh
from schemas.objects import PerceivedObjects
from tableverse_factory.evaluation.bench.completion import render_noisy_view, score_completion, stand_on_table
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.mesh.voxel_solids import extract_surface, make_grid
from tableverse_factory.stages.place.completion.select_shape import complete_by_carving
from tableverse_factory.stages.place.completion.sheet import carve_sheet
from tableverse_factory.stages.place.view.object_view import ObjectView, view_object
from tableverse_factory.stages.place.view.support_from_depth import find_supports

THICKNESS_M = 0.005


def make_dish(*, solid: bool = False) -> TriangleMesh:
    """An oval dish 18 cm long with a rim that rises by 3 cm, or all between it and the table."""
    u, v = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, 200), np.linspace(-1, 1, 200)))
    away = np.hypot(u, v)
    middle = np.stack([0.09 * u, 0.055 * v, 0.03 * np.clip(2 * away - 1, 0.0, 1.0) ** 1.5], axis=1)[away <= 1.0]
    grid = make_grid(middle.min(axis=0) - 0.004, middle.max(axis=0) + 0.004, 0.0015)
    points = grid.points()
    field = THICKNESS_M / 2 - cKDTree(middle).query(points)[0]
    if solid:
        beside, nearest = cKDTree(middle[:, :2]).query(points[:, :2])
        field = np.maximum(field, np.minimum(middle[nearest, 2] - points[:, 2], 0.002 - beside))
    return stand_on_table(extract_surface(field.reshape(grid.shape), grid))


def look(mesh: TriangleMesh, azimuth: float = 1.9) -> tuple[PerceivedObjects, ObjectView]:
    scene = render_noisy_view([mesh], azimuth, 0.8, np.random.default_rng(7))
    support = find_supports(scene.objects, scene.camera_to_table)[scene.objects[0].object_id]
    return scene, view_object(scene, scene.objects[0], support)


@pytest.mark.parametrize("azimuth", [0.4, pytest.param(1.9, marks=pytest.mark.slow)])
def test_a_dish_is_as_thin_below_as_its_rim_shows(azimuth):
    dish = make_dish()
    scene, view = look(dish, azimuth)
    found = complete_by_carving(scene, view)
    assert found.pose is not None
    assert found.method == "carved/sheet"
    score = score_completion("dish", 0, found.method, dish, place_mesh(found.mesh, found.pose, 1.0))
    assert score.iou > 0.65  # 0.45 as columns or inflated
    assert score.chamfer_m < 0.0018


def test_a_block_with_a_hollow_on_top_is_no_sheet():
    assert carve_sheet(look(make_dish(solid=True))[1]) is None
