"""Laws of placements on scenes of boxes, balls and bowls, whose truth is known on paper."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.config import TrajectoriesConfig
from schemas.curation import Relation
from schemas.geometry import Pose, TriangleMesh
from schemas.trajectories import Placement
from tableverse_factory.geometry.math.transforms import quaternion_about_z, rotation_matrix
from tableverse_factory.geometry.mesh.meshes import from_trimesh, place_mesh
from tableverse_factory.geometry.relations.relations import compute_body_features, relation_holds
from tableverse_factory.physics.mjcf.scene_objects import SceneObject, make_scene_object
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.robotics.placements.clearance import are_outlines_clear, compute_box_gaps, compute_least_gaps
from tableverse_factory.robotics.placements.domains import SIDES, build_domain, sample_regions
from tableverse_factory.robotics.placements.on_and_in import WALL_CLEARANCE_M
from tableverse_factory.robotics.placements.request import RELEASE_HEIGHT_M, NoPlacement
from tableverse_factory.robotics.placements.sampling import sample_placements
from tests.helpers.examples import scale_examples
from tests.helpers.simple_scenes import ball, box, cylinder

TABLE = Slab(np.zeros(2), np.array([0.5, 0.4]), 0.0, (150, 120, 90))
CONFIG = TrajectoriesConfig()
ON_TABLE = list(SIDES)


def standing(name: str, mesh: TriangleMesh, x: float, y: float, yaw: float = 0.0, z: float = 0.0) -> SceneObject:
    lowest = float(mesh.vertices[:, 2].min())
    return make_scene_object(name, mesh, (mesh,), Pose(np.array([x, y, z - lowest]), quaternion_about_z(yaw)), 0.2)


def bowl(x: float, y: float, radius: float, height: float, wall: float = 0.005, name: str = "y") -> SceneObject:
    """A dish of one floor and 24 staves, which are its convex pieces; its mesh is their union, cut exactly."""
    outer, inner = trimesh.creation.cylinder(radius, height), trimesh.creation.cylinder(radius - wall, height)
    inner.apply_translation([0, 0, wall])
    mesh = from_trimesh(trimesh.boolean.difference([outer, inner], engine="manifold"))
    angles = np.linspace(0, 2 * np.pi, 33)  # the corners of trimesh's cylinders
    rim = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    pieces = []
    for a, b in pairwise(rim):
        ring = np.array([a * radius, b * radius, b * (radius - wall), a * (radius - wall)])
        pieces.append(np.concatenate([np.column_stack([ring, np.full(4, z)]) for z in (-height / 2, height / 2)]))
    pieces.append(trimesh.creation.cylinder(radius - wall, wall).vertices - [0, 0, (height - wall) / 2])
    hulls = tuple(from_trimesh(trimesh.convex.convex_hull(points)) for points in pieces)
    return make_scene_object(name, mesh, hulls, Pose(np.array([x, y, height / 2]), quaternion_about_z(0.0)), 0.4)


def found(relation, x, y, others=(), table=TABLE, config=CONFIG, seed=0) -> tuple[Placement, ...]:
    result = sample_placements(relation, x, y, others, table, config, np.random.default_rng(seed))
    assert not isinstance(result, NoPlacement), result
    assert 0 < len(result) <= config.placements
    return result


def refused(relation, x, y, others=(), table=TABLE, config=CONFIG) -> str:
    result = sample_placements(relation, x, y, others, table, config, np.random.default_rng(0))
    assert isinstance(result, NoPlacement), result
    assert result.detail
    return result.reason


def at_rest(x: SceneObject, place: Placement) -> TriangleMesh:
    pose = Pose(place.pose.position - [0, 0, place.drop_m], place.pose.quaternion_wxyz)
    return place_mesh(x.mesh, pose)


def scene() -> tuple[SceneObject, SceneObject, list[SceneObject]]:
    x = standing("x", box(0.05, 0.03, 0.06), 0.3, -0.25, 0.3)
    y = bowl(0.02, 0.01, 0.07, 0.05)
    others = [standing("a", cylinder(0.03, 0.12), -0.12, 0.12), standing("b", box(0.2, 0.02, 0.1), 0.0, -0.18, 0.4)]
    return x, y, others


@pytest.mark.heavy
@pytest.mark.parametrize("relation", ON_TABLE)
def test_beside_the_reference_all_stand_clear_on_the_table_where_the_relation_holds(relation):
    x, y, others = scene()
    if relation is Relation.OUTSIDE:
        x = standing("x", box(0.05, 0.03, 0.06), 0.02, 0.01, z=0.005)
    for place in found(relation, x, y, others):
        rest = at_rest(x, place)
        low, high = rest.vertices.min(axis=0), rest.vertices.max(axis=0)
        assert low[2] == pytest.approx(0.0, abs=1e-9)
        assert place.drop_m == RELEASE_HEIGHT_M
        assert (np.abs(rest.vertices[:, :2]) <= TABLE.half_size_xy).all()
        assert place.clear_by == "boxes"
        assert compute_least_gaps(low[None], high[None], [o.body for o in (y, *others)])[0] >= CONFIG.epsilon_m - 1e-6
        assert relation_holds(relation, compute_body_features(rest), y.body)


@pytest.mark.parametrize(
    ("relation", "axis", "sign"),
    [(Relation.LEFT, 0, -1), (Relation.RIGHT, 0, 1), (Relation.IN_FRONT, 1, -1), (Relation.BEHIND, 1, 1)],
)
def test_a_side_begins_beyond_the_margin_and_is_as_wide_as_the_reference(relation, axis, sign):
    x, y, others = scene()
    config = TrajectoriesConfig(delta_margin_m=0.035)
    for place in found(relation, x, y, others, config=config):
        low, high = (f(at_rest(x, place).vertices, axis=0) for f in (np.min, np.max))
        gap = low[axis] - y.body.high[axis] if sign > 0 else y.body.low[axis] - high[axis]
        middle = (low + high) / 2
        assert gap >= 0.035 - 1e-9
        assert y.body.low[1 - axis] - 1e-9 <= middle[1 - axis] <= y.body.high[1 - axis] + 1e-9


def test_every_relation_has_a_domain_and_all_samples_lie_in_it():
    y, rng = standing("y", box(0.1, 0.06, 0.04), 0.1, 0.2).body, np.random.default_rng(3)
    for relation in Relation:
        regions = build_domain(relation, np.array([0.02, 0.03]), y, 0.02)
        points = sample_regions(regions, 500, rng)
        assert len(points) == 500
        assert np.any([region.contains(points) for region in regions], axis=0).all()
    empty = regions[0].intersect(np.array([9.0, 9.0]), np.array([10.0, 10.0]))
    assert empty.area == 0.0
    assert sample_regions((empty,), 10, rng).shape == (0, 2)


def test_the_top_of_the_paper_is_the_upper_face():
    y = standing("y", box(0.1, 0.06, 0.04), 0.1, 0.2).body
    (region,) = build_domain(Relation.ON, np.array([0.02, 0.03]), y, 0.02)
    np.testing.assert_allclose(region.low, [0.05, 0.17])
    np.testing.assert_allclose(region.high, [0.15, 0.23])


def test_a_box_on_a_box_stands_on_it_with_its_centre_over_it():
    x, y = standing("x", box(0.04, 0.06, 0.05), 0.3, 0.2), standing("y", box(0.12, 0.1, 0.07), -0.1, 0.0, 0.2)
    for place in found(Relation.ON, x, y):
        rest = at_rest(x, place)
        assert rest.vertices[:, 2].min() == pytest.approx(0.07, abs=1e-6)
        away = rotation_matrix(quaternion_about_z(-0.2)) @ (place.pose.position - y.pose.position)
        assert (np.abs(away[:2]) <= [0.06, 0.05]).all()


def test_on_a_stack_only_what_is_free_of_the_top_is_used():
    y, top = standing("y", box(0.2, 0.1, 0.05), 0.0, 0.0), standing("z", box(0.08, 0.09, 0.05), -0.05, 0.0, z=0.05)
    x = standing("x", box(0.04, 0.04, 0.05), 0.3, 0.2)
    for place in found(Relation.ON, x, y, [top]):
        assert at_rest(x, place).vertices[:, 0].min() >= -0.01 + CONFIG.epsilon_m - 1e-6
    assert refused(Relation.ON, x, y, [standing("z", box(0.19, 0.09, 0.05), 0.0, 0.0, z=0.05)]) == "no_room"


def test_what_stands_high_may_reach_out_over_something_lower():
    x, y = standing("x", box(0.07, 0.07, 0.04), 0.3, 0.2), standing("y", cylinder(0.035, 0.1), 0.0, 0.0)
    low, tall = (
        [standing(f"n{sign}", box(0.02, 0.2, height), sign * 0.05, 0.0) for sign in (-1, 1)] for height in (0.05, 0.2)
    )
    assert found(Relation.ON, x, y, low)
    assert refused(Relation.ON, x, y, tall) == "no_room"


@pytest.mark.parametrize("relation", [Relation.IN, Relation.INTO, Relation.INSIDE])
def test_a_ball_comes_to_lie_on_the_floor_of_a_bowl_within_its_wall(relation):
    x, y = standing("x", ball(0.025), 0.3, 0.2), bowl(-0.1, 0.05, 0.08, 0.06)
    for place in found(relation, x, y):
        rest = at_rest(x, place)
        assert rest.vertices[:, 2].min() == pytest.approx(0.005, abs=1e-4)
        assert np.linalg.norm(rest.vertices[:, :2] - [-0.1, 0.05], axis=1).max() <= 0.0751


def test_into_a_narrow_vessel_it_is_let_go_with_its_top_above_the_rim_first():
    x, y = standing("x", ball(0.02), 0.3, 0.2), bowl(-0.1, 0.05, 0.035, 0.1)
    places = found(Relation.IN, x, y)
    tops = [place_mesh(x.mesh, place.pose).vertices[:, 2].max() for place in places]
    assert tops[0] >= 0.1 + 0.019
    assert places[0].drop_m > 0.05
    assert min(place.drop_m for place in places) == pytest.approx(WALL_CLEARANCE_M, abs=1e-4)


def test_a_long_thing_goes_into_a_cup_on_its_end():
    pen = box(0.14, 0.01, 0.01)
    x, y = standing("x", pen, 0.3, 0.2), bowl(-0.1, 0.05, 0.04, 0.09)
    for place in found(Relation.IN, x, y):
        axis = rotation_matrix(place.pose.quaternion_wxyz)[:, 0]
        assert abs(axis[2]) > 0.99
        assert relation_holds(Relation.IN, compute_body_features(at_rest(x, place)), y.body)


def test_what_would_topple_out_of_a_dish_is_not_stood_on_its_end_in_it():
    dish = bowl(-0.1, 0.05, 0.07, 0.05)
    assert refused(Relation.IN, standing("x", box(0.26, 0.012, 0.008), 0.3, 0.2), dish) == "no_room"
    assert found(Relation.IN, standing("x", box(0.16, 0.06, 0.06), 0.3, 0.2), dish)


def test_on_contents_it_lies_higher_and_an_empty_spot_is_better():
    y, content = bowl(0.0, 0.0, 0.09, 0.08), standing("c", ball(0.02), -0.05, 0.0, z=0.005)
    x = standing("x", box(0.03, 0.03, 0.03), 0.3, 0.2)
    places = found(Relation.IN, x, y, [content])
    assert at_rest(x, places[0]).vertices[:, 2].min() == pytest.approx(0.005, abs=1e-4)


def test_reasons():
    x, y = standing("x", box(0.05, 0.05, 0.05), 0.3, 0.2), standing("y", box(0.05, 0.05, 0.05), 0.0, 0.0)
    assert refused(Relation.IN, x, y) == "no_container"
    assert refused(Relation.ON, x, standing("y", ball(0.05), 0.0, 0.0)) == "no_stable_top"
    assert refused(Relation.IN, x, bowl(0.0, 0.0, 0.03, 0.05)) == "no_room"
    at_edge = Slab(np.array([0.2, 0.1]), np.array([0.23, 0.2]), 0.0, (0, 0, 0))
    assert refused(Relation.LEFT, x, y, table=at_edge) == "no_room"
    ring = [standing(f"w{k}", box(0.3, 0.02, 0.1), *place) for k, place in enumerate([(0, 0.08), (0, -0.08)])]
    ring += [standing(f"v{k}", box(0.02, 0.3, 0.1), *place) for k, place in enumerate([(0.08, 0), (-0.08, 0)])]
    assert refused(Relation.NEXT_TO, x, y, ring) == "no_room"
    leaning = Pose(np.array([0.3, 0.2, 0.05]), np.array([np.cos(0.3), np.sin(0.3), 0.0, 0.0]))
    tilted = make_scene_object("x", x.mesh, (x.mesh,), leaning, 0.2)
    assert refused(Relation.LEFT, tilted, y) == "does_not_stand"


def test_where_boxes_leave_no_room_outlines_do_and_say_so():
    y = standing("y", cylinder(0.03, 0.1), 0.0, 0.0)
    # two long walls aslant: their boxes cover all there is to the right of y, their outlines a strip
    walls = [standing(f"w{k}", box(0.6, 0.01, 0.1), 0.15 + k, -k, np.pi / 4) for k in (-0.035, 0.035)]
    x = standing("x", cylinder(0.02, 0.05), -0.3, 0.2)
    places = found(Relation.RIGHT, x, y, walls)
    assert {place.clear_by for place in places} == {"outlines"}
    for place in places:
        assert are_outlines_clear(
            compute_body_features(at_rest(x, place)), [w.body for w in walls], CONFIG.epsilon_m - 1e-4
        )


def test_what_holds_already_is_moved_all_the_same():
    x, y = standing("x", box(0.04, 0.04, 0.05), 0.1, 0.0), standing("y", box(0.05, 0.05, 0.05), 0.0, 0.0)
    assert relation_holds(Relation.RIGHT, x.body, y.body)
    for place in found(Relation.RIGHT, x, y, config=TrajectoriesConfig(placements=4)):
        assert np.linalg.norm(place.pose.position[:2] - x.pose.position[:2]) > 0.038


def test_same_state_same_placements_and_another_state_others():
    x, y, others = scene()
    first, same, another = (found(Relation.NEXT_TO, x, y, others, seed=seed) for seed in (1, 1, 2))
    poses = [[(*p.pose.position, *p.pose.quaternion_wxyz) for p in places] for places in (first, same, another)]
    assert poses[0] == poses[1] != poses[2]


def test_the_first_ones_differ_so_that_a_planner_has_a_choice():
    x, y = standing("x", cylinder(0.02, 0.05), 0.3, 0.2), standing("y", box(0.06, 0.06, 0.05), 0.0, 0.0)
    places = found(Relation.NEXT_TO, x, y)
    positions = np.array([place.pose.position[:2] for place in places[:12]])
    assert np.ptp(positions, axis=0).min() > 0.1


@pytest.mark.heavy
@settings(max_examples=scale_examples(25), deadline=None)
@given(
    st.tuples(st.floats(-0.3, 0.3), st.floats(-0.2, 0.2), st.floats(-3.1, 3.1)),
    st.tuples(*(st.floats(0.01, 0.15) for _ in range(3))),
    st.sampled_from([Relation.LEFT, Relation.BEHIND, Relation.NEXT_TO, Relation.ON]),
    st.floats(-3.1, 3.1),
)
def test_no_placement_leaves_a_turned_table_or_the_relation(where, size, relation, yaw):
    table = Slab(np.array([0.05, -0.02]), np.array([0.4, 0.3]), yaw, (0, 0, 0))
    y, x = standing("y", box(*size), *where), standing("x", box(0.05, 0.03, 0.04), 0.0, 0.0)
    config = TrajectoriesConfig(placements=6)
    result = sample_placements(relation, x, y, (), table, config, np.random.default_rng(0))
    if isinstance(result, NoPlacement):
        return
    for place in result:
        rest = at_rest(x, place)
        assert relation_holds(relation, compute_body_features(rest), y.body)
        if relation is not Relation.ON:
            assert table.holds(rest.vertices).all()


@pytest.mark.heavy
@pytest.mark.parametrize(
    "changes",
    [{"epsilon_m": 0.0, "delta_margin_m": 0.0}, {"epsilon_m": 5.0}, {"delta_margin_m": 50.0}, {"placements": 1}],
)
def test_odd_settings_give_an_answer(changes):
    x, y, others = scene()
    for relation in Relation:
        config = TrajectoriesConfig(**changes)
        result = sample_placements(relation, x, y, others, TABLE, config, np.random.default_rng(0))
        assert isinstance(result, NoPlacement) or len(result) <= config.placements


def test_a_table_of_no_size_carries_nothing():
    x, y, others = scene()
    nothing = Slab(np.zeros(2), np.zeros(2), 0.0, (0, 0, 0))
    assert refused(Relation.LEFT, x, y, others, table=nothing) == "no_room"


def test_boxes_are_apart_as_soon_as_one_axis_is():
    here = np.zeros((1, 3)), np.full((1, 3), 0.1)
    others = [standing("a", box(0.1, 0.1, 0.1), *xy).body for xy in ((0.17, 0.05), (0.05, 0.05), (0.17, 0.17))]
    np.testing.assert_allclose(compute_box_gaps(*here, others), [[0.02, -0.1, 0.02]], atol=1e-12)
    np.testing.assert_allclose(compute_box_gaps(here[0] + [0, 0, 0.15], here[1] + 0.15, others[1:2], True), [[0.05]])
    assert compute_least_gaps(*here, ())[0] == np.inf


@pytest.mark.parametrize(("rim", "stands"), [(0.003, True), (0.009, False)])
def test_on_pieces_that_fill_a_plate_it_stands_higher_unless_that_is_no_longer_on_it(rim, stands):
    plate = bowl(-0.1, 0.05, 0.1, 0.005 + rim)
    filled = trimesh.convex.convex_hull(plate.mesh.vertices)
    plate = make_scene_object("y", plate.mesh, (from_trimesh(filled),), plate.pose, 0.4)
    x = standing("x", box(0.05, 0.05, 0.05), 0.3, 0.2)
    if not stands:
        assert refused(Relation.ON, x, plate) == "no_room"
        return
    for place in found(Relation.ON, x, plate):
        assert at_rest(x, place).vertices[:, 2].min() == pytest.approx(0.005 + rim, abs=1e-5)
        assert place.drop_m == RELEASE_HEIGHT_M
