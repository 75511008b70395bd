"""Where two fingers hold: on the mesh, and on the pieces that a simulation feels in its place."""

import numpy as np
import pytest
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene
from tableverse_factory.geometry.relations.antipodal import filter_grips, find_antipodal_grips

OPENING_M = 0.078


def _standing(mesh: trimesh.Trimesh) -> TriangleMesh:
    mesh.apply_translation([0.0, 0.0, -mesh.bounds[0, 2]])
    return from_trimesh(mesh)


def _bottle() -> TriangleMesh:
    """A body too wide for the hand, and a neck of 30 mm upon it."""
    body = trimesh.creation.cylinder(0.05, 0.1)
    neck = trimesh.creation.cylinder(0.015, 0.04, transform=trimesh.transformations.translation_matrix((0, 0, 0.068)))
    return _standing(trimesh.boolean.union([body, neck]))


def test_pieces_that_are_the_mesh_hold_as_it_does() -> None:
    box = _standing(trimesh.creation.box((0.04, 0.06, 0.1)))
    grips = find_antipodal_grips(box, make_raycasting_scene(box), OPENING_M)
    felt = filter_grips(grips, make_raycasting_scene(box), OPENING_M)
    assert grips.share > 0.3
    assert felt.share == pytest.approx(grips.share)
    np.testing.assert_allclose(felt.first, grips.first)


def test_a_neck_that_the_pieces_round_off_does_not_hold() -> None:
    bottle = _bottle()
    hull = from_trimesh(trimesh.Trimesh(bottle.vertices, bottle.faces, process=False).convex_hull)
    grips = find_antipodal_grips(bottle, make_raycasting_scene(bottle), OPENING_M)
    assert len(grips.first) > 5, "the neck can be held"
    felt = filter_grips(grips, make_raycasting_scene(hull), OPENING_M)
    assert felt.share == len(felt.first) == 0, "its hull is a cone, from which pads slide"


def test_pieces_wider_than_the_hand_do_not_hold() -> None:
    plate = _standing(trimesh.creation.box((0.07, 0.07, 0.07)))
    grips = find_antipodal_grips(plate, make_raycasting_scene(plate), OPENING_M)
    swollen = from_trimesh(
        trimesh.creation.box((0.081, 0.081, 0.081), trimesh.transformations.translation_matrix((0, 0, 0.035)))
    )
    assert len(grips.first)
    assert not len(filter_grips(grips, make_raycasting_scene(swollen), OPENING_M).first)


def test_nothing_to_hold_stays_nothing() -> None:
    ball = _standing(trimesh.creation.icosphere(radius=0.2))
    grips = find_antipodal_grips(ball, make_raycasting_scene(ball), OPENING_M)
    assert not len(grips.first)
    assert filter_grips(grips, make_raycasting_scene(ball), OPENING_M).share == 0.0
