"""Planes between pieces: what they allow is free."""

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from tableverse_factory.geometry.collision.linear_sweep import LinearSweep, MovingSolid, find_nearest_point
from tableverse_factory.geometry.collision.separating_planes import PlaneFinder, PosedPieces
from tableverse_factory.geometry.collision.solids import Solids
from tableverse_factory.geometry.math.transforms import quaternion_from_rotation_vector, rotation_matrix
from tests.helpers.examples import scale_examples

MARGIN, REACH = 0.001, 0.02


def hulls(seed: int) -> Solids:
    """Two or three random convex pieces near the origin."""
    rng = np.random.default_rng(seed)
    meshes = [
        trimesh.convex.convex_hull(rng.normal(rng.normal(0.0, 0.02, 3), 0.02, (12, 3)))
        for _ in range(int(rng.integers(2, 4)))
    ]
    return Solids([np.array(m.vertices) for m in meshes], [np.array(m.faces, dtype=np.int32) for m in meshes])


def cube(size: float, center: tuple[float, float, float]) -> Solids:
    mesh = trimesh.creation.box([size] * 3)
    return Solids([np.array(mesh.vertices) + center], [np.array(mesh.faces, dtype=np.int32)])


def stance(solids: Solids, shift: np.ndarray, turn: np.ndarray | None = None) -> PosedPieces:
    vector = np.zeros(3) if turn is None else turn
    return PosedPieces(solids, rotation_matrix(quaternion_from_rotation_vector(vector)), shift)


@pytest.mark.heavy
@settings(max_examples=scale_examples(40), deadline=None)
@given(st.integers(0, 10**6), st.sampled_from([-1.0, 0.0, 1.0]))
def test_a_translation_that_satisfies_every_plane_is_free(seed: int, rise: float) -> None:
    rng = np.random.default_rng(seed)
    a, b = hulls(seed), hulls(seed + 1)
    shift = rng.normal(0.0, 0.03, 3)
    planes = list(PlaneFinder().planes(stance(a, shift), stance(b, np.zeros(3)), MARGIN, 1.0, rise))
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    along = np.array([plane.direction @ way for plane in planes])
    spare = np.array([plane.spare_m for plane in planes])
    if (along[spare < 0.0] <= 0.05).any():
        return  # this way does not part them
    needed = max([0.0, *(-spare[spare < 0.0] / along[spare < 0.0])])
    if (spare + needed * along < 0.0).any():
        return
    gap, _ = find_nearest_point(MovingSolid(a, shift + needed * way), MovingSolid(b, np.zeros(3)), 1.0)
    assert gap >= MARGIN - 1e-7


def test_the_plane_between_two_cubes_is_known() -> None:
    [plane] = PlaneFinder().planes(
        stance(cube(0.1, (0, 0, 0)), np.array([0.12, 0.0, 0.0])),
        stance(cube(0.1, (0, 0, 0)), np.zeros(3)),
        0.005,
        0.1,
        0.0,
    )
    assert plane.direction == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    assert plane.spare_m == pytest.approx(0.015)
    assert plane.spares_m == pytest.approx(np.full(len(plane.spares_m), 0.015))


def test_what_stands_beside_goes_aside_and_what_belongs_above_goes_up() -> None:
    plate = trimesh.creation.box([0.2, 0.2, 0.01])
    solids = Solids([np.array(plate.vertices)], [np.array(plate.faces, dtype=np.int32)])
    upper, lower = stance(solids, np.array([0.19, 0.0, 0.004])), stance(solids, np.zeros(3))
    [beside] = PlaneFinder().planes(upper, lower, MARGIN, REACH, 0.0)
    assert beside.direction == pytest.approx([1.0, 0.0, 0.0], abs=1e-6)
    [above] = PlaneFinder().planes(upper, lower, MARGIN, REACH, 1.0)
    assert above.direction == pytest.approx([0.0, 0.0, 1.0], abs=1e-6)
    [below] = PlaneFinder().planes(upper, lower, MARGIN, REACH, -1.0)
    assert below.direction == pytest.approx([0.0, 0.0, -1.0], abs=1e-6)


def test_a_stance_turns_about_the_origin_and_moves_then() -> None:
    there = stance(cube(0.1, (0.2, 0, 0)), np.array([0.0, 0.0, 0.3]), np.array([0.0, 0.0, np.pi / 2]))
    assert there.least == pytest.approx([-0.05, 0.15, 0.25])
    assert there.most == pytest.approx([0.05, 0.25, 0.35])


@pytest.mark.heavy
@settings(max_examples=scale_examples(40), deadline=None)
@given(st.integers(0, 10**6))
def test_room_ends_where_the_clearance_begins(seed: int) -> None:
    rng = np.random.default_rng(seed)
    way = rng.normal(size=3)
    way /= np.linalg.norm(way)
    moving, fixed = (
        MovingSolid(hulls(seed), -0.3 * way + rng.normal(0.0, 0.01, 3)),
        MovingSolid(hulls(seed + 1), np.zeros(3)),
    )
    room = LinearSweep(way).room([moving], [fixed], MARGIN, 0.6)
    for share in np.linspace(0.0, 1.0, 20):
        assert find_nearest_point(moving.moved(share * room * way), fixed, 1.0)[0] >= MARGIN - 1e-6
    if room < 0.6:
        assert find_nearest_point(moving.moved((room + 1e-5) * way), fixed, 1.0)[0] < MARGIN


def test_there_is_no_room_inside_and_all_of_it_on_the_way_out() -> None:
    a, b = (
        MovingSolid(cube(0.1, (0, 0, 0)), np.zeros(3)),
        MovingSolid(cube(0.1, (0, 0, 0)), np.array([0.0, 0.0, -0.1002])),
    )
    down, up = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, 1.0])
    assert LinearSweep(down).room([a], [b], MARGIN, 1.0) == 0.0
    assert LinearSweep(up).room([a], [b], MARGIN, 1.0) == 1.0
