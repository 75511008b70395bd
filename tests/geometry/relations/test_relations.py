"""Laws of the ten relations, on solids whose truth is plain."""

import numpy as np
import pytest
import trimesh
from hypothesis import example, given, settings
from hypothesis import strategies as st

from schemas.curation import Relation
from schemas.geometry import TriangleMesh
from schemas.objects import Table
from tableverse_factory.geometry.mesh.height_maps import CELL_M, compute_height_map, rotate_quarter_turn
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.geometry.mesh.raycasting import make_raycasting_scene
from tableverse_factory.geometry.relations.antipodal import find_antipodal_grips
from tableverse_factory.geometry.relations.relations import (
    BodyFeatures,
    compute_body_features,
    measure_outline_gap,
    relation_holds,
    relation_nearly_holds,
    rotate_body_quarter_turn,
)
from tableverse_factory.geometry.relations.stable_placement import find_placement, make_support_surface
from tests.helpers.examples import scale_examples

TABLE = Table(np.zeros(2), np.array([0.6, 0.6]), 0.0, (0, 0, 0), 0.0)
CONTAINING = (Relation.IN, Relation.INTO, Relation.INSIDE)
CONVERSES = (
    (Relation.LEFT, Relation.RIGHT),
    (Relation.IN_FRONT, Relation.BEHIND),
    (Relation.NEXT_TO, Relation.NEXT_TO),
)

places = st.tuples(*[st.floats(-0.2, 0.2)] * 2)
sizes = st.tuples(*[st.floats(0.02, 0.15)] * 3)


def mesh_of(solid: trimesh.Trimesh, x: float, y: float, z: float = 0.0) -> TriangleMesh:
    solid = solid.copy()
    solid.apply_translation([x, y, z - solid.bounds[0, 2]])
    return from_trimesh(solid)


def box(size, x=0.0, y=0.0, z=0.0) -> BodyFeatures:
    return compute_body_features(mesh_of(trimesh.creation.box(size), x, y, z))


def bowl_solid(radius=0.08, height=0.06, wall=0.004) -> trimesh.Trimesh:
    line = [(0, 0), (radius, 0), (radius, height), (radius - wall, height), (radius - wall, wall), (0, wall)]
    return trimesh.creation.revolve(np.array(line), sections=64)


def bowl(x=0.0, y=0.0, **shape) -> BodyFeatures:
    return compute_body_features(mesh_of(bowl_solid(**shape), x, y))


def ball(radius, x=0.0, y=0.0, z=0.0) -> BodyFeatures:
    return compute_body_features(mesh_of(trimesh.creation.icosphere(3, radius), x, y, z))


@pytest.mark.heavy
@settings(max_examples=scale_examples(40), deadline=None)
@given(sizes, places, sizes, places)
def test_converse_relations(size_a, at_a, size_b, at_b):
    a, b = box(size_a, *at_a), box(size_b, *at_b)
    for relation, converse in CONVERSES:
        assert relation_holds(relation, a, b) == relation_holds(converse, b, a)
    assert not (relation_holds(Relation.LEFT, a, b) and relation_holds(Relation.RIGHT, a, b))
    assert not (relation_holds(Relation.BEHIND, a, b) and relation_holds(Relation.IN_FRONT, a, b))
    assert not (relation_holds(Relation.ON, a, b) and relation_holds(Relation.ON, b, a))
    for relation in Relation:
        assert not relation_holds(relation, a, b) or relation_nearly_holds(relation, a, b)


@pytest.mark.heavy
@settings(max_examples=scale_examples(30), deadline=None)
@given(sizes, places, sizes, places)
def test_a_mirrored_scene_mirrors_its_relations(size_a, at_a, size_b, at_b):
    a, b = box(size_a, *at_a), box(size_b, *at_b)
    mirrored_a, mirrored_b = box(size_a, -at_a[0], at_a[1]), box(size_b, -at_b[0], at_b[1])
    assert relation_holds(Relation.LEFT, a, b) == relation_holds(Relation.RIGHT, mirrored_a, mirrored_b)
    for relation in (Relation.BEHIND, Relation.IN_FRONT, Relation.NEXT_TO):
        assert relation_holds(relation, a, b) == relation_holds(relation, mirrored_a, mirrored_b)


@pytest.mark.heavy
@settings(max_examples=scale_examples(30), deadline=None)
@given(sizes, places, sizes, places)
def test_the_gap_of_axis_aligned_boxes_is_the_gap_of_their_boxes(size_a, at_a, size_b, at_b):
    a, b = box(size_a, *at_a), box(size_b, *at_b)
    apart = np.maximum(np.maximum(a.low - b.high, b.low - a.high)[:2], 0.0)
    assert measure_outline_gap(a, b) == pytest.approx(float(np.hypot(*apart)), abs=1e-9)


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("relation", "at"),
    [
        (Relation.LEFT, (-0.2, 0.0)),
        (Relation.RIGHT, (0.2, 0.0)),
        (Relation.IN_FRONT, (0.0, -0.2)),
        (Relation.BEHIND, (0.0, 0.2)),
    ],
)
def test_the_viewer_stands_on_the_camera_side(relation, at):
    held = {r for r in Relation if relation_holds(r, box((0.05, 0.05, 0.05), *at), box((0.05, 0.05, 0.05)))}
    assert held == {relation, Relation.OUTSIDE}


@pytest.mark.parametrize(("gap", "beside"), [(0.01, True), (0.059, True), (0.061, False)])
def test_next_to_ends_at_six_centimetres(gap, beside):
    assert relation_holds(Relation.NEXT_TO, box((0.05, 0.05, 0.1)), box((0.05, 0.05, 0.05), 0.05 + gap)) is beside


def test_on_needs_contact_from_above_and_the_middle_over_it():
    table = box((0.2, 0.2, 0.05))
    assert relation_holds(Relation.ON, box((0.05, 0.05, 0.05), 0.0, 0.0, 0.05), table)
    assert relation_holds(Relation.ON, box((0.05, 0.05, 0.05), 0.09, 0.0, 0.05), table)
    assert not relation_holds(Relation.ON, box((0.05, 0.05, 0.05), 0.12, 0.0, 0.05), table)
    assert not relation_holds(Relation.ON, box((0.05, 0.05, 0.05), 0.0, 0.0, 0.07), table)
    assert not relation_holds(Relation.ON, box((0.05, 0.05, 0.05), 0.2, 0.0), table)
    assert not relation_holds(Relation.ON, table, box((0.05, 0.05, 0.05), 0.0, 0.0, 0.05))


def test_inside_is_in_the_cavity_not_in_the_box():
    vessel = bowl()
    inside, above, beside = ball(0.03, 0, 0, 0.004), ball(0.03, 0, 0, 0.08), ball(0.03, 0.14)
    for relation in CONTAINING:
        assert relation_holds(relation, inside, vessel)
        assert not relation_holds(relation, above, vessel)
        assert not relation_holds(relation, beside, vessel)
        assert not relation_holds(relation, inside, box((0.16, 0.16, 0.06)))  # a solid has no inside
    assert not relation_holds(Relation.OUTSIDE, inside, vessel)
    assert relation_holds(Relation.OUTSIDE, beside, vessel)
    assert not relation_holds(Relation.ON, inside, vessel)
    assert relation_holds(
        Relation.ON, inside, compute_body_features(mesh_of(trimesh.creation.cylinder(0.1, 0.004), 0, 0))
    )


def test_what_a_tilted_vessel_stands_on_is_not_inside_it():
    """Seen from above it is within the opening and below the rim, but under the floor."""
    tilted = bowl_solid()
    tilted.apply_transform(trimesh.transformations.rotation_matrix(np.radians(20), (0, 1, 0)))
    vessel = compute_body_features(mesh_of(tilted, 0, 0))
    pen = trimesh.creation.box((0.012, 0.08, 0.012))
    assert vessel.cavity is not None
    under, within = compute_body_features(mesh_of(pen, -0.02, 0)), compute_body_features(mesh_of(pen, -0.02, 0, 0.04))
    assert under.high[2] < vessel.cavity.rim_z
    for relation in CONTAINING:
        assert not relation_holds(relation, under, vessel)
        assert relation_holds(relation, within, vessel)
    assert relation_holds(Relation.OUTSIDE, under, vessel)


@pytest.mark.heavy
@settings(max_examples=scale_examples(25), deadline=None)
@given(st.floats(-0.12, 0.12), st.floats(-0.12, 0.12), st.floats(0.004, 0.1))
def test_inside_implies_within_the_box_of_the_vessel(x, y, z):
    vessel, thing = bowl(), ball(0.02, x, y, z)
    if relation_holds(Relation.INSIDE, thing, vessel):
        middle = (thing.low + thing.high)[:2] / 2
        assert (middle >= vessel.low[:2]).all()
        assert (middle <= vessel.high[:2]).all()
        assert vessel.low[2] <= thing.low[2] < vessel.high[2]


@pytest.mark.parametrize(
    ("shape", "is_vessel"),
    [
        ({"radius": 0.08, "height": 0.06}, True),
        ({"radius": 0.035, "height": 0.09, "wall": 0.0025}, True),
        ({"radius": 0.13, "height": 0.02}, False),  # a plate
        ({"radius": 0.012, "height": 0.04}, False),  # no room for anything
    ],
)
def test_a_vessel_needs_depth_and_width(shape, is_vessel):
    cavity = bowl(**shape).cavity
    assert (cavity is not None) == is_vessel
    if cavity is not None:
        wall = shape.get("wall", 0.004)
        assert cavity.depth == pytest.approx(shape["height"] - wall, abs=1e-3)
        true = np.pi * (shape["radius"] - wall) ** 2 * (shape["height"] - wall)
        assert cavity.volume_m3 == pytest.approx(true, rel=0.15)


@pytest.mark.heavy
@settings(max_examples=scale_examples(40), deadline=None)
@given(
    radius=st.floats(0.02, 0.07),
    height=st.floats(0.05, 0.12),
    wall=st.sampled_from([0.0008, 0.0015, 0.002, 0.003, 0.005]),
    flare=st.sampled_from([1.0, 1.3]),
    draft=st.sampled_from([0.0, 0.2, 0.35]),
    sections=st.sampled_from([12, 32, 64]),
    at=st.tuples(*[st.floats(-0.3, 0.3)] * 2),
    yaw=st.floats(0.0, 2 * np.pi),
)
@example(0.043, 0.054, 0.002, 1.0, 0.0, 64, (0.1, 0.05), 0.3)
@example(0.06, 0.1, 0.0008, 1.3, 0.0, 12, (0.0, 0.0), 0.0)
@example(0.04, 0.09, 0.002, 1.0, 0.35, 24, (0.1, 0.05), 0.3)
def test_a_vessel_is_found_however_thin_its_wall_and_wherever_it_stands(
    radius, height, wall, flare, draft, sections, at, yaw
):
    # Of few faces, so that no vertices fill the rim between rays; from above a flared wall is a slope, and of walls
    # that a mould draws, thinner at the rim on both sides, all faces look up.
    profile = [
        [0.0, 0.0], [radius + wall, 0.0], [flare * radius + (1.0 - draft) * wall, height],
        [flare * radius + draft * wall, height], [radius, 0.004], [0.0, 0.004],
    ]  # fmt: skip
    solid = trimesh.creation.revolve(profile, sections=sections)
    solid.apply_transform(trimesh.transformations.rotation_matrix(yaw, [0, 0, 1]))
    cavity = compute_body_features(mesh_of(solid, *at)).cavity
    assert cavity is not None
    assert cavity.rim_z == pytest.approx(height, abs=1e-6)
    assert cavity.floor_z == pytest.approx(0.004, abs=2.5e-3)


@given(st.integers(0, 2**31))
def test_no_edge_rises_above_its_cells_or_hangs_below_them(seed):
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-0.05, 0.05, (6, 3))
    mesh = TriangleMesh(corners, np.array([[0, 1, 2], [3, 4, 5]], dtype=np.int32))
    heights = compute_height_map(mesh, make_raycasting_scene(mesh))
    for a, b in ((0, 1), (1, 2), (2, 0), (3, 4), (4, 5), (5, 3)):
        points = corners[a] + rng.uniform(0.0, 1.0, (50, 1)) * (corners[b] - corners[a])
        i, j = (np.floor(points[:, :2] / CELL_M).astype(int) - heights.corner).T
        assert (heights.top[i, j] >= points[:, 2] - 1e-9).all()
        assert (heights.bottom[i, j] <= points[:, 2] + 1e-9).all()


def test_no_vessel_upside_down_lying_or_with_a_hole_in_its_floor():
    upside_down, lying = bowl_solid(), bowl_solid(0.04, 0.1)
    upside_down.apply_transform(trimesh.transformations.rotation_matrix(np.pi, [1, 0, 0]))
    lying.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0]))
    ring = trimesh.creation.annulus(0.05, 0.06, 0.05)
    for solid in (upside_down, lying, ring):
        assert compute_body_features(mesh_of(solid, 0, 0)).cavity is None


def test_height_map_of_a_box_is_its_top_and_bottom():
    mesh = mesh_of(trimesh.creation.box((0.06, 0.03, 0.05)), 0.1, -0.2, 0.02)
    heights = compute_height_map(mesh, make_raycasting_scene(mesh))
    assert heights.filled.all()
    np.testing.assert_allclose(heights.top, 0.07, atol=1e-6)
    np.testing.assert_allclose(heights.bottom, 0.02, atol=1e-6)
    assert heights.filled.sum() * CELL_M**2 == pytest.approx(0.06 * 0.03, rel=0.2)


def test_four_quarter_turns_are_none():
    body = box((0.06, 0.03, 0.05), 0.101, -0.2)
    turned = body
    for _ in range(4):
        turned = rotate_body_quarter_turn(turned)
    np.testing.assert_allclose(turned.low, body.low)
    assert turned.heights.corner == body.heights.corner
    np.testing.assert_array_equal(turned.heights.top, body.heights.top)
    once = rotate_quarter_turn(body.heights)
    assert once.top.shape == body.heights.top.shape[::-1]


@pytest.mark.parametrize("relation", list(Relation))
def test_a_place_that_is_found_holds_is_free_and_is_on_the_table(relation):
    vessel, thing = bowl(0.0, 0.0), ball(0.025, 0.2, 0.2)
    slab = box((0.12, 0.12, 0.05), -0.2, 0.1)
    wall = box((0.02, 0.3, 0.2), 0.11, 0.0)
    reference = slab if relation is Relation.ON else vessel
    scene = make_support_surface((thing, vessel, slab, wall), TABLE)
    found = find_placement(relation, thing, reference, scene, scene.without(0))
    assert found is not None
    assert relation_holds(relation, found.body, reference)
    assert (np.abs(found.body.low[:2]) <= 0.6).all()
    for other in (vessel, slab, wall):
        overlap = np.minimum(found.body.high, other.high) - np.maximum(found.body.low, other.low)
        assert other is reference or (overlap < 0).any()
    if relation is Relation.ON:
        assert found.body.low[2] == pytest.approx(0.05, abs=1e-4)


def test_no_place_where_there_is_no_room():
    block, reference = box((0.1, 0.1, 0.1), 0.4, 0.4), box((0.1, 0.1, 0.1), -0.2, 0.0)
    small = Table(np.array([0.1, 0.2]), np.array([0.36, 0.3]), 0.0, (0, 0, 0), 0.0)
    scene = make_support_surface((block, reference), small)
    assert find_placement(Relation.LEFT, block, reference, scene, scene.without(0)) is None
    assert find_placement(Relation.RIGHT, block, reference, scene, scene.without(0)) is not None


@pytest.mark.parametrize(
    ("support", "carries"),
    [
        (trimesh.creation.box((0.1, 0.1, 0.05)), True),
        (trimesh.creation.cylinder(0.1, 0.012), True),
        (trimesh.creation.icosphere(3, 0.05), False),
        (bowl_solid(), False),
        (trimesh.creation.box((0.3, 0.02, 0.01)), False),  # a knife
        (trimesh.creation.cone(0.06, 0.1), False),
    ],
)
def test_only_flat_tops_carry(support, carries):
    can, below = (
        compute_body_features(mesh_of(trimesh.creation.cylinder(0.03, 0.1), 0.3, 0.3)),
        compute_body_features(mesh_of(support, 0, 0)),
    )
    scene = make_support_surface((can, below), TABLE)
    assert (find_placement(Relation.ON, can, below, scene, scene.without(0)) is not None) == carries


@pytest.mark.parametrize(
    ("solid", "graspable"),
    [
        (trimesh.creation.box((0.07, 0.2, 0.2)), True),
        (trimesh.creation.box((0.085, 0.2, 0.2)), False),
        (trimesh.creation.icosphere(3, 0.035), True),
        (trimesh.creation.icosphere(3, 0.045), False),
        (bowl_solid(), True),  # by its wall
        (trimesh.creation.box((0.2, 0.2, 0.003)), False),  # a sheet on the table
    ],
)
def test_a_gripper_holds_what_fits_between_its_fingers(solid, graspable):
    mesh = mesh_of(solid, 0.1, 0.1)
    grips = find_antipodal_grips(mesh, make_raycasting_scene(mesh), 0.078)
    assert (grips.share > 0.01) == graspable
    width = np.linalg.norm(grips.second - grips.first, axis=1)
    assert (width <= 0.078).all()
