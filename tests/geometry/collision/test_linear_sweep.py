"""The exact distance along a ray against brute force, and against what can be computed by hand."""

import coal
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.geometry import ConvexPieces
from tableverse_factory.geometry.collision.linear_sweep import LinearSweep, MovingSolid, are_within, complete_basis
from tableverse_factory.geometry.collision.solids import place_pieces
from tableverse_factory.geometry.math.transforms import identity_pose
from tableverse_factory.geometry.mesh.hulls import make_hull_mesh

UP = np.array([0.0, 0.0, 1.0])
CLEARANCE = 0.0005
STEP = 0.0005


def body(rng: np.random.Generator, pieces: int, spread: float = 0.06) -> MovingSolid:
    """Random tetrahedra to icosahedra around the origin, some long and thin."""
    hulls = []
    for _ in range(pieces):
        points = rng.normal(size=(int(rng.integers(4, 13)), 3)) * rng.uniform(0.003, 0.03, 3)
        hulls.append(make_hull_mesh(points + rng.uniform(-spread, spread, 3)))
    return MovingSolid(place_pieces(ConvexPieces(tuple(hulls), 1.0, 0.0, "cut"), identity_pose(), 1.0), np.zeros(3))


def gap_at(a: MovingSolid, b: MovingSolid, shift: np.ndarray) -> float:
    """Least distance of any two pieces with `a` moved: every pair is asked."""
    request, result = coal.DistanceRequest(), coal.DistanceResult()
    moved, still = coal.Transform3s(), coal.Transform3s()
    moved.setTranslation(a.offset - b.offset + shift)
    gaps = []
    for i in range(len(a.solids.starts)):
        for j in range(len(b.solids.starts)):
            result.clear()
            gaps.append(coal.distance(a.solids.shape(i), moved, b.solids.shape(j), still, request, result))
    return min(gaps)


@pytest.mark.heavy
@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_no_smaller_distance_is_clear(seed: int) -> None:
    rng = np.random.default_rng(seed)
    moving, fixed = body(rng, int(rng.integers(1, 5))), body(rng, int(rng.integers(1, 5)))
    direction = UP if rng.random() < 0.3 else np.append(rng.normal(size=2), 0.0)
    direction = direction / np.linalg.norm(direction)
    d = LinearSweep(direction).find_first_clear([moving], [fixed], CLEARANCE)
    assert gap_at(moving, fixed, d * direction) >= CLEARANCE - 1e-6
    earlier = np.append(np.arange(0.0, d, STEP), max(d - 2e-6, 0.0)) if d > 0.0 else np.zeros(0)
    assert all(gap_at(moving, fixed, smaller * direction) < CLEARANCE + 1e-6 for smaller in earlier)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_from_the_answer_on_nothing_is_to_do(seed: int) -> None:
    rng = np.random.default_rng(seed)
    moving, fixed = body(rng, 3), body(rng, 3)
    direction = complete_basis(rng.normal(size=3))[:, 1]
    d = LinearSweep(direction).find_first_clear([moving], [fixed], CLEARANCE)
    assert LinearSweep(direction).find_first_clear([moving.moved(d * direction)], [fixed], CLEARANCE) <= 1e-6


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_search_only_raises_its_bound(seed: int) -> None:
    rng = np.random.default_rng(seed)
    moving, fixed = body(rng, 3), body(rng, 3)
    search, bounds = LinearSweep(UP).search([moving], [fixed], CLEARANCE), [0.0]
    while not search.done:
        search.advance()
        bounds.append(search.d)
    assert bounds == sorted(bounds)
    assert search.d == LinearSweep(UP).find_first_clear([moving], [fixed], CLEARANCE)


@given(st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1))
def test_a_basis_is_right_handed_and_begins_with_its_direction(direction: tuple[float, float, float]) -> None:
    unit = np.array(direction) / np.linalg.norm(direction)
    basis = complete_basis(unit)
    np.testing.assert_array_equal(basis[:, 0], unit)
    np.testing.assert_allclose(basis.T @ basis, np.eye(3), atol=1e-12)
    assert np.linalg.det(basis) > 0.0


def test_the_first_gap_is_taken_and_not_a_later_one() -> None:
    """Three slabs in a row; a thin slab that starts in the first fits between it and the second."""
    slab = np.array([[x, y, z] for x in (-0.01, 0.01) for y in (-0.1, 0.1) for z in (-0.1, 0.1)])
    row = [make_hull_mesh(slab + np.array([x, 0.0, 0.0])) for x in (0.0, 0.05, 0.1)]
    fixed = MovingSolid(place_pieces(ConvexPieces(tuple(row), 1.0, 0.0, "cut"), identity_pose(), 1.0), np.zeros(3))
    thin = ConvexPieces((make_hull_mesh(slab * [0.5, 1.0, 1.0]),), 1.0, 0.0, "cut")
    moving = MovingSolid(place_pieces(thin, identity_pose(), 1.0), np.zeros(3))
    d = LinearSweep(np.array([1.0, 0.0, 0.0])).find_first_clear([moving], [fixed], CLEARANCE)
    assert d == pytest.approx(0.015 + CLEARANCE, abs=1e-6)
    wide = ConvexPieces(
        (make_hull_mesh(slab * [1.5, 1.0, 1.0]),), 1.0, 0.0, "cut"
    )  # 30 mm: too wide for the gaps of 30 mm
    moving = MovingSolid(place_pieces(wide, identity_pose(), 1.0), np.zeros(3))
    d = LinearSweep(np.array([1.0, 0.0, 0.0])).find_first_clear([moving], [fixed], CLEARANCE)
    assert d == pytest.approx(0.1 + 0.01 + 0.015 + CLEARANCE, abs=1e-6)


def test_two_spheres_as_fine_polyhedra_part_at_the_known_distance() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(2000, 3))
    sphere = ConvexPieces(
        (make_hull_mesh(0.03 * points / np.linalg.norm(points, axis=1, keepdims=True)),), 1.0, 0.0, "cut"
    )
    solids = place_pieces(sphere, identity_pose(), 1.0)
    moving, fixed = MovingSolid(solids, np.array([0.01, 0.02, 0.0])), MovingSolid(solids, np.zeros(3))
    d = LinearSweep(np.array([1.0, 0.0, 0.0])).find_first_clear([moving], [fixed], 0.0)
    assert d == pytest.approx(np.sqrt(0.06**2 - 0.02**2) - 0.01, abs=3e-4)


def test_uncovered_meshes_are_kept_further_apart() -> None:
    cube = make_hull_mesh(np.array([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.1)]))
    solids = place_pieces(ConvexPieces((cube,), 1.0, 0.0, "convex"), identity_pose(), 1.0)
    d = LinearSweep(UP).find_first_clear(
        [MovingSolid(solids, np.zeros(3), 0.001)], [MovingSolid(solids, np.zeros(3), 0.002)], CLEARANCE
    )
    assert d == pytest.approx(0.103 + CLEARANCE, abs=1e-6)


def test_what_moves_away_or_past_is_clear_at_once() -> None:
    cube = make_hull_mesh(np.array([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.1)]))
    solids = place_pieces(ConvexPieces((cube,), 1.0, 0.0, "convex"), identity_pose(), 1.0)
    fixed = MovingSolid(solids, np.zeros(3))
    for offset in ([0.1005, 0.0, 0.0], [-0.3, 0.1005, 0.0], [0.0, 0.0, 0.2], [-0.3, 0.0, 0.0]):
        ray = LinearSweep(np.array([1.0, 0.0, 0.0]))
        assert ray.find_first_clear([MovingSolid(solids, np.array(offset))], [fixed], CLEARANCE) == 0.0


@pytest.mark.parametrize("gap", [0.0, 0.001, 0.0099])
def test_contact_is_seen_through_a_gap(gap: float) -> None:
    cube = make_hull_mesh(np.array([[x, y, z] for x in (0.0, 0.1) for y in (0.0, 0.1) for z in (0.0, 0.1)]))
    solids = place_pieces(ConvexPieces((cube,), 1.0, 0.0, "convex"), identity_pose(), 1.0)
    above = MovingSolid(solids, np.array([0.02, 0.02, 0.1 + gap]))
    assert are_within(above, MovingSolid(solids, np.zeros(3)), 0.01)
    assert not are_within(above.moved(0.02 * UP), MovingSolid(solids, np.zeros(3)), 0.01)
