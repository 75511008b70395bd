"""Where two fingers hold: on the mesh, and on the pieces that a simulation feels in its place."""

import numpy as np
import pytest
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.height_maps import column_caster
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.relations.antipodal import antipodal_grips, gripped_on

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
    grips = antipodal_grips(box, column_caster(box), OPENING_M)
    felt = gripped_on(grips, column_caster(box), OPENING_M)
    assert grips.share > 0.3
    assert felt.share == pytest.approx(grips.share)
    np.testing.assert_allclose(felt.first, grips.first)


def test_a_neck_that_the_pieces_round_off_does_not_hold() -> None:
    bottle = _bottle()
    hull = from_trimesh(trimesh.Trimesh(bottle.vertices, bottle.faces, process=False).convex_hull)
    grips = antipodal_grips(bottle, column_caster(bottle), OPENING_M)
    assert len(grips.first) > 5, "the neck can be held"
    felt = gripped_on(grips, column_caster(hull), OPENING_M)
    assert felt.share == len(felt.first) == 0, "its hull is a cone, from which pads slide"


def test_pieces_wider_than_the_hand_do_not_hold() -> None:
    plate = _standing(trimesh.creation.box((0.07, 0.07, 0.07)))
    grips = antipodal_grips(plate, column_caster(plate), OPENING_M)
    swollen = from_trimesh(
        trimesh.creation.box((0.081, 0.081, 0.081), trimesh.transformations.translation_matrix((0, 0, 0.035)))
    )
    assert len(grips.first)
    assert not len(gripped_on(grips, column_caster(swollen), OPENING_M).first)


def test_nothing_to_hold_stays_nothing() -> None:
    ball = _standing(trimesh.creation.icosphere(radius=0.2))
    grips = antipodal_grips(ball, column_caster(ball), OPENING_M)
    assert not len(grips.first)
    assert gripped_on(grips, column_caster(ball), OPENING_M).share == 0.0
