"""Balls inside closed meshes: none sticks out, and where something is thick, one is found."""

import manifold3d
import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tableverse_factory.geometry.collision.inscribed_ball import find_largest_ball
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.repair import make_closed_solid, mesh_to_solid, solid_to_mesh
from tests.helpers.bad_meshes import bowl
from tests.helpers.examples import scale_examples

RING = from_trimesh(trimesh.creation.torus(0.05, 0.015, 48, 24))
SPHERE = from_trimesh(trimesh.creation.icosphere(3, 0.05))


def box() -> manifold3d.Manifold:
    return manifold3d.Manifold.cube([0.1, 0.08, 0.06], True)


def tray() -> manifold3d.Manifold:
    return box() - manifold3d.Manifold.cube([0.09, 0.07, 0.06], True).translate([0.0, 0.0, 0.006])


@pytest.mark.parametrize(
    ("mesh", "diameter", "at_most"),
    [
        (solid_to_mesh(box().refine(6)), 0.06, 0.06),
        (solid_to_mesh(tray().refine(8)), 2e-3 * (8 - 21**0.5), 0.06),  # where three walls of 5, 5 and 6 mm meet
        (SPHERE, 0.1, 0.1),
        (solid_to_mesh(make_closed_solid(bowl(bottomless=False))[0]), 0.0011, 0.07),
    ],
    ids=["box", "tray", "ball", "bowl of one sheet"],
)
def test_the_ball_is_as_large_as_the_shape_is_thick(mesh, diameter, at_most):
    assert find_largest_ball(mesh, 0.0, at_most) == pytest.approx(diameter, rel=0.1)


@settings(max_examples=scale_examples(40))
@given(st.floats(1e-8, 1e-3), st.floats(5e-4, 0.01), st.floats(1e-3, 0.02), st.integers(0, 2**31))
@example(1e-6, 0.003, 0.004, 0)
def test_a_film_around_something_thick_hides_nothing_and_is_not_thick(film, deep, wide, turn):
    # A peg under a plate, cut off where the plate is a film.
    plate = manifold3d.Manifold.cube([0.2, 0.2, film])
    peg = manifold3d.Manifold.cube([wide, wide, deep + film]).translate([0.03, 0.05, -deep])
    turned = [solid.transform(_turn(turn)) for solid in (plate, plate + peg)]
    alone, both = (find_largest_ball(solid_to_mesh(solid), 0.0, deep + film) for solid in turned)
    assert alone <= film * 1.01 + 1e-7
    assert min(deep + film, 2 / 3 * wide) * 0.99 <= both <= (deep + film) * (1.0 + 1e-12)


@pytest.mark.heavy
@given(st.integers(0, 2**31), st.floats(0.02, 0.06))
def test_no_ball_reaches_out_of_what_two_rings_share(turn, apart):
    ring = mesh_to_solid(RING)
    shared = ring ^ ring.transform(_turn(turn)).translate([apart, 0.0, 0.0])
    for region in shared.decompose():
        # A ball inside has no more volume, and no more than the ring's own thickness.
        found = find_largest_ball(solid_to_mesh(region), 0.0, 0.2)
        assert np.pi / 6 * found**3 <= region.volume() * 1.01
        assert found <= 0.03 * 1.01


@pytest.mark.heavy
def test_a_finely_divided_shell_takes_no_time_to_speak_of():
    # Centres that all begin in its middle, from which every face is as near as any other, take half a minute.
    outer, inner = trimesh.creation.icosphere(5, 0.05), trimesh.creation.icosphere(5, 0.045)
    inner.invert()
    shell = from_trimesh(trimesh.util.concatenate([outer, inner]))
    assert find_largest_ball(shell, 0.001, 0.1) == pytest.approx(0.005, rel=0.02)
    assert find_largest_ball(from_trimesh(outer), 0.05, 0.1) == pytest.approx(0.1, rel=0.02)


def test_what_is_smaller_than_asked_for_is_not_looked_for():
    assert find_largest_ball(SPHERE, 0.101, 0.2) == 0.0


def _turn(seed: int) -> np.ndarray:
    return np.column_stack([Rotation.random(random_state=seed).as_matrix(), np.zeros(3)])
