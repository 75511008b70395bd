"""A round bowl is bent to what the picture shows: to itself not at all, and to an oval and tilted one closely."""

import numpy as np
import pytest
from manifold3d import CrossSection, Manifold

from schemas.geometry import Points
from tableverse_factory.evaluation.bench.completion import render_noisy_view
from tableverse_factory.geometry.mesh.voxel_solids import from_manifold
from tableverse_factory.stages.place.completion.warp import fit_warp
from tableverse_factory.stages.place.view.object_view import view_object
from tableverse_factory.stages.place.view.support_from_depth import find_supports

MIDDLE = np.array([0.0, 0.0, 0.02])
OVAL = np.array([[1.02, 0.0, 0.004], [0.0, 0.98, 0.0], [0.01, 0.0, 1.0]])


def make_bowl() -> Manifold:
    profile = np.array([[0.0, 0.003], [0.0, 0.005], [0.04, 0.005], [0.068, 0.04], [0.07, 0.04], [0.042, 0.003]])
    return Manifold.revolve(CrossSection([profile[::-1]]).simplify(1e-6), 60)


def bend_bowl(shape: np.ndarray) -> tuple[Points, Points]:
    """Vertices of a bowl bent by a matrix, and those of the round one, warped to a picture of the bent one."""
    bowl = make_bowl()
    bent = bowl.warp_batch(lambda places: (np.asarray(places) - MIDDLE) @ shape.T + MIDDLE)
    scene = render_noisy_view([from_manifold(bent)], 0.4, 0.8, np.random.default_rng(3))
    support = find_supports(scene.objects, scene.camera_to_table)[scene.objects[0].object_id]
    warp = fit_warp(view_object(scene, scene.objects[0], support), bowl, MIDDLE)
    round_ones = from_manifold(bowl).vertices
    return (round_ones - MIDDLE) @ shape.T + MIDDLE, warp(round_ones)


@pytest.mark.parametrize("shape", [np.eye(3), OVAL], ids=["round", "oval"])
def test_a_bowl_is_bent_to_the_points_seen(shape):
    true, warped = bend_bowl(shape)
    assert np.linalg.norm(warped - true, axis=1).mean() < 4e-4  # 1.2 mm for the oval one as it was


def test_the_same_picture_gives_the_same_bytes():
    assert bend_bowl(OVAL)[1].tobytes() == bend_bowl(OVAL)[1].tobytes()
