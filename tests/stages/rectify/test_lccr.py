"""What the paper promises of LCCR, and what it leaves open."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings

from schemas.config import RectifyConfig
from schemas.objects import PlacedObject
from tableverse_factory.stages.rectify.fault_check import MAX_HOVER_M
from tableverse_factory.stages.rectify.groups import measure_lowest_m
from tableverse_factory.stages.rectify.lccr import RectificationResult, rectify_lccr
from tableverse_factory.stages.rectify.radial import compute_azimuths, list_members, order_radially, spread_groups
from tableverse_factory.stages.rectify.rigid_part import RigidPart, compute_center
from tableverse_factory.stages.rectify.vertical import disentangle
from tests.helpers.convex_layouts import ball, box, channel, layouts, offsets, part, placed, smallest_gap
from tests.helpers.examples import scale_examples

CONFIG = RectifyConfig()
LAWS = settings(max_examples=scale_examples(40), deadline=None)


def rectified(items: Sequence[PlacedObject], config: RectifyConfig = CONFIG) -> RectificationResult:
    return rectify_lccr([part(item) for item in items], config)


def smallest_gap_to(one: RigidPart, others: Sequence[RigidPart]) -> float:
    return min(smallest_gap([one, other]) for other in others)


@pytest.mark.heavy
@LAWS
@given(layouts())
def test_the_azimuth_of_every_group_stays_and_the_root_does_not_move(items: list[PlacedObject]) -> None:
    result = rectified(items)
    before = compute_azimuths([part(item) for item in items], result.groups)
    after = compute_azimuths(result.parts, result.groups)
    known = ~np.isnan(before)
    assert np.abs((after - before + np.pi) % (2 * np.pi) - np.pi)[known].max(initial=0.0) < 1e-9
    root = [i for entity in result.groups[0] for i in entity]
    assert not offsets(result)[root, :2].any()


@pytest.mark.heavy
@LAWS
@given(layouts())
def test_groups_move_outward_and_as_one(items: list[PlacedObject]) -> None:
    parts = [part(item) for item in items]
    result = rectified(items)
    origin = compute_center(list_members(parts, result.groups[0]))
    for group in result.groups[1:]:
        moves = offsets(result)[[i for entity in group for i in entity], :2]
        assert np.ptp(moves, axis=0).max() < 1e-12
        away = compute_center(list_members(parts, group)) - origin
        assert moves[0] @ away >= -1e-12


@pytest.mark.heavy
@LAWS
@given(layouts())
def test_groups_are_taken_by_their_distance_from_the_root(items: list[PlacedObject]) -> None:
    parts = [part(item) for item in items]
    groups = rectified(items).groups
    origin = compute_center(list_members(parts, groups[0]))
    distances = [np.linalg.norm(compute_center(list_members(parts, group)) - origin) for group in groups]
    assert all(a <= b + 1e-9 for a, b in pairwise(distances))


@pytest.mark.heavy
@LAWS
@given(layouts())
def test_every_group_stands_on_the_table(items: list[PlacedObject]) -> None:
    result = rectified(items)
    lowest = np.array([measure_lowest_m(result.parts, group) for group in result.groups])
    moved = offsets(result).any()
    assert lowest.min() > -1e-9
    assert lowest.max() < (1e-9 if moved else MAX_HOVER_M + 1e-9)


@pytest.mark.heavy
@LAWS
@given(layouts())
def test_no_group_could_have_stopped_earlier(items: list[PlacedObject]) -> None:
    """Equation (2) by brute force: at none of many smaller distances is a group clear of all groups before it."""
    parts = [part(item) for item in items]
    groups = [((i,),) for i in range(len(parts))]
    ordered = order_radially(parts, groups)
    spread_out = spread_groups(parts, ordered, CONFIG.clearance_m)
    placed_before = [spread_out[ordered[0][0][0]]]
    for group in ordered[1:]:
        [[i]] = group
        way = spread_out[i].body.offset
        for share in np.linspace(0.0, 1.0, 40, endpoint=False):
            there = parts[i].moved(share * way)
            if (1 - share) * np.linalg.norm(way) > 1e-6:
                assert smallest_gap_to(there, placed_before) < CONFIG.clearance_m
        placed_before.append(spread_out[i])


def test_the_smallest_gap_is_sought_among_all_pieces() -> None:
    walls_cross = [channel("a", (0.0, 0.0, 0.0)), channel("b", (0.0, 0.05, 0.02))]
    assert smallest_gap(walls_cross) < 0.0


def test_what_floats_or_sinks_is_put_on_the_table() -> None:
    result = rectified([placed("a", box(0.1, 0.1, 0.1), (0, 0, 0.2)), placed("b", ball(0.03), (0.3, 0, -0.01))])
    assert [moved.lowest_now_m for moved in result.parts] == pytest.approx([0.0, 0.0], abs=1e-15)


def test_two_boxes_are_parted_by_what_they_overlap_and_the_clearance() -> None:
    items = [
        placed("a", box(0.1, 0.1, 0.1), (0, 0, 0.05)),
        placed("b", box(0.1, 0.1, 0.1), (0.08, 0, 0.05)),
        placed("c", box(0.1, 0.1, 0.1), (-0.2, 0, 0.05)),
    ]
    result = rectified(items)
    assert offsets(result)[1] == pytest.approx([0.02 + CONFIG.clearance_m, 0, 0], abs=1e-6)
    assert offsets(result)[[0, 2]] == pytest.approx(np.zeros((2, 3)), abs=1e-15)


def test_half_an_overlap_makes_a_group_and_a_little_less_does_not() -> None:
    plate = placed("a", box(0.2, 0.2, 0.02), (0, 0, 0.01))
    together = rectified([plate, placed("b", box(0.1, 0.1, 0.1), (0.1, 0, 0.06))])
    apart = rectified([plate, placed("b", box(0.1, 0.1, 0.1), (0.101, 0, 0.06))])
    assert len(together.groups) == 1
    assert len(apart.groups) == 2


def test_boxes_that_overlap_only_from_above_are_no_group() -> None:
    high = placed("b", box(0.1, 0.1, 0.1), (0, 0, 0.5))
    assert len(rectified([placed("a", box(0.2, 0.2, 0.02), (0, 0, 0.01)), high]).groups) == 2


def test_the_smaller_footprint_rises_out_of_the_larger() -> None:
    result = rectified(
        [placed("a", box(0.05, 0.05, 0.1), (0, 0, 0.05)), placed("b", box(0.2, 0.2, 0.03), (0, 0, 0.015))]
    )
    assert offsets(result)[0] == pytest.approx([0, 0, 0.03 + CONFIG.clearance_m], abs=1e-6)
    assert not offsets(result)[1].any()


def test_coincident_centres_are_parted_along_the_heading_of_the_one_that_moves() -> None:
    items = [
        placed("a", box(0.3, 0.02, 0.02), (0, 0, 0.01)),
        placed("b", box(0.3, 0.02, 0.02), (0, 0, 0.01), np.pi / 2),
    ]
    result = rectified(items)
    assert len(result.groups) == 2
    assert offsets(result)[1] == pytest.approx([0, 0.16 + CONFIG.clearance_m, 0], abs=1e-6)


def test_equals_are_told_apart_by_id() -> None:
    items = [placed(name, box(0.1, 0.1, 0.1), (x, 0, 0.05)) for name, x in (("b", 0.04), ("a", -0.04))]
    result = rectified(items, CONFIG.model_copy(update={"overlap_ratio": 0.9}))
    assert result.groups[0] == ((1,),)
    assert offsets(result)[1, 0] == 0.0


def test_one_object_is_only_put_down() -> None:
    result = rectified([placed("a", ball(0.05), (0.3, -0.2, 0.7))])
    assert result.groups == (((0,),),)
    assert offsets(result)[0, :2].tolist() == [0.0, 0.0]


def test_an_object_inside_a_solid_comes_out_on_top() -> None:
    result = rectified([placed("a", box(0.2, 0.2, 0.2), (0, 0, 0.1)), placed("b", ball(0.02), (0.01, 0, 0.1))])
    assert smallest_gap(result.parts) >= CONFIG.clearance_m - 1e-6
    assert result.parts[1].lowest_now_m == pytest.approx(0.2 + CONFIG.clearance_m, abs=1e-6)


def test_a_group_that_spans_the_root_goes_all_the_way() -> None:
    root = placed("a", box(0.02, 0.02, 0.3), (0, 0, 0.15))
    beam = placed("b", box(0.4, 0.02, 0.02), (0.015, 0, 0.2))
    others = [placed(name, box(0.01, 0.01, 0.01), (x, 0.3, 0.005)) for name, x in (("c", -0.2), ("d", 0.2))]
    below = [placed("e", box(0.01, 0.01, 0.01), (0, -0.6, 0.005))]
    result = rectified([root, beam, *others, *below], CONFIG.model_copy(update={"overlap_ratio": 1.0}))
    assert smallest_gap(result.parts) >= CONFIG.clearance_m - 1e-6


def test_contents_move_with_their_container_and_rise_out_of_its_walls() -> None:
    tray = placed("tray", box(0.2, 0.2, 0.02), (0, 0, 0.01))
    fruit = placed("fruit", ball(0.03), (0.05, 0, 0.03), contained_in="tray")
    far = placed("far", ball(0.02), (0.09, 0.09, 0.01), contained_in="tray")
    wall = [placed(f"wall_{k}", box(0.3, 0.3, 0.3), (-0.15 + 0.3 * k, 0.35 * k, 0.15)) for k in (-1, 0, 1)]
    items = [tray, fruit, far, *wall]
    result = rectified(items)
    inside = offsets(result)[:3, :2]
    assert np.ptp(inside, axis=0).max() < 1e-12
    assert any({0, 1, 2} <= set(entity) for group in result.groups for entity in group)
    assert smallest_gap(result.parts) >= CONFIG.clearance_m - 1e-6


def test_containers_that_hold_one_another_end_free_too() -> None:
    items = [
        placed("a", box(0.1, 0.1, 0.1), (0, 0, 0.05), contained_in="b"),
        placed("b", box(0.08, 0.08, 0.08), (0, 0, 0.05), contained_in="a"),
    ]
    result = rectified(items)
    assert len(result.groups) == 1
    assert smallest_gap(result.parts) >= CONFIG.clearance_m - 1e-6


def test_a_broad_plate_on_a_narrow_pitcher_is_put_down_when_the_pitcher_rises() -> None:
    items = [placed("pitcher", box(0.1, 0.1, 0.2), (0, 0, 0.1)), placed("plate", box(0.25, 0.25, 0.02), (0, 0, 0.205))]
    result = rectified(items)
    lowest = [moved.lowest_now_m for moved in result.parts]
    assert lowest == pytest.approx([0.02 + CONFIG.clearance_m, 0.0], abs=1e-6)


@pytest.mark.parametrize(("thickness", "goes_out"), [(0.3, True), (0.01, False)])
def test_a_part_that_rises_under_anothers_overhang_ends_free(thickness: float, goes_out: bool) -> None:
    """The cup rises out of its plate, into the roof of another group: the paper's phase 3 ends there."""
    items = [
        placed("a_roof", box(0.3, 0.3, thickness), (0, 0, 0.1 + thickness / 2)),
        placed("a_post", box(0.05, 0.05, 0.099), (0, 0, 0.0495)),
        placed("plate", box(0.2, 0.2, 0.05), (0.2, 0, 0.025)),
        placed("cup", box(0.06, 0.06, 0.07), (0.13, 0, 0.035)),
    ]
    plain = disentangle([part(item) for item in items], [((0,), (1,)), ((2,), (3,))], CONFIG.clearance_m)
    assert smallest_gap(plain) < 0.0
    result = rectified(items)
    assert smallest_gap(result.parts) >= CONFIG.clearance_m - 1e-6
    assert (offsets(result)[2, 0] > 0.0) == goes_out
    assert not offsets(result)[:2].any()
