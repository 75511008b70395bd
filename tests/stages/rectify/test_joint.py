"""What the joint rectification alone promises: least, order kept, and who carries whom stays."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.optimize import isotonic_regression

from schemas.codec import encode
from schemas.config import Config, RectifyConfig
from schemas.objects import PlacedObject, PlacedObjects, Table
from schemas.outcome import Done
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.geometry.collision.penetration import measure_mesh_penetrations, measure_piece_penetrations
from tableverse_factory.geometry.collision.solids import concatenate_solids
from tableverse_factory.geometry.math.transforms import (
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_angle,
    rotation_matrix,
)
from tableverse_factory.geometry.relations.support import find_piece_support
from tableverse_factory.models.services import Services
from tableverse_factory.stages.rectify.joint import is_order_kept, rectify_jointly
from tableverse_factory.stages.rectify.lccr import RectificationResult
from tableverse_factory.stages.rectify.quarter_turn_symmetry import count_quarter_turns
from tableverse_factory.stages.rectify.rectify import rectify
from tableverse_factory.stages.rectify.rigid_part import RigidPart, compute_box, merge_rigid_parts
from tableverse_factory.stages.rectify.support import read_support
from tests.helpers.convex_layouts import ball, box, layouts, offsets, part, placed, quarter_turns, smallest_gap, turned
from tests.helpers.examples import scale_examples

CONFIG = RectifyConfig(method="joint")
LAWS = settings(max_examples=scale_examples(25), deadline=None)


def rectified(items: Sequence[PlacedObject]) -> RectificationResult:
    return rectify_jointly([part(item) for item in items], CONFIG)


def tilted(item: PlacedObject, x_deg: float, y_deg: float = 0.0) -> PlacedObject:
    turn = quaternion_from_rotation_vector(np.radians([x_deg, y_deg, 0.0]))
    pose = replace(item.pose, quaternion_wxyz=multiply_quaternions(turn, item.pose.quaternion_wxyz))
    return replace(item, pose=pose)


def tilt_deg(quaternion_wxyz: np.ndarray) -> float:
    return float(np.degrees(np.arccos(np.clip(rotation_matrix(quaternion_wxyz)[2, 2], -1.0, 1.0))))


def test_nothing_stays_nothing() -> None:
    assert rectify_jointly([], CONFIG).parts == ()


@pytest.mark.heavy
@LAWS
@given(layouts())
def test_nothing_is_below_the_table_and_every_group_stands_on_it(items: list[PlacedObject]) -> None:
    result = rectified(items)
    lowest = np.array([moved.lowest_now_m for moved in result.parts])
    assert lowest.min() > -1e-9
    for group in result.groups:
        assert min(lowest[i] for entity in group for i in entity) < 1e-6


@pytest.mark.heavy
@LAWS
@given(layouts())
def test_the_order_around_the_root_stays(items: list[PlacedObject]) -> None:
    result = rectified(items)
    before = ways([part(item) for item in items], result)
    after = ways(result.parts, result)
    for i, j, k in combinations(np.flatnonzero(~np.isnan(before + after).any(axis=1)), 3):
        if min(np.abs(before[i] - before[j]).max(), np.abs(after[i] - after[j]).max()) < 1e-3:
            continue
        first, last = turning(before[[i, j, k]]), turning(after[[i, j, k]])
        assert abs(first) < 1e-4 or first * last > -1e-6


def ways(parts: Sequence[RigidPart], result: RectificationResult) -> np.ndarray:
    """Unit vectors from the root's centre to that of each other group, seen from above; NaN where they coincide."""
    boxes = [np.concatenate([compute_box([parts[i]]) for entity in group for i in entity]) for group in result.groups]
    away = np.array([(box.min(axis=0) + box.max(axis=0)) / 2 for box in boxes])
    away = away[1:] - away[0]
    length = np.linalg.norm(away, axis=1, keepdims=True)
    return np.where(length < 1e-6, np.nan, away / np.maximum(length, 1e-6))


def turning(three: np.ndarray) -> float:
    """Positive where three directions follow one another counter-clockwise, negative where clockwise."""
    (ax, ay), (bx, by), (cx, cy) = three
    return float((bx - ax) * (cy - ay) - (by - ay) * (cx - ax))


@pytest.mark.parametrize("angle", [0.0, 0.4, 2.0])
def test_a_row_moves_the_least(angle: float) -> None:
    """Along one line the least motion is an isotonic regression."""
    at = np.array([-0.192, -0.096, 0.0, 0.092, 0.186])
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    items = [
        placed(f"obj_{k}", box(0.1, 0.1, 0.1), (x * along[0], x * along[1], 0.05), angle) for k, x in enumerate(at)
    ]
    ahead = (0.1 + CONFIG.clearance_m) * np.arange(5)
    least = isotonic_regression(at - ahead).x + ahead - at
    assert np.abs(offsets(rectified(items)) - least[:, None] * along).max() < 2e-5


@pytest.mark.heavy
@LAWS
@given(layouts())
def test_the_same_layout_gives_the_same_result(items: list[PlacedObject]) -> None:
    first, second = rectified(items), rectified(items)
    assert (offsets(first) == offsets(second)).all()


@pytest.mark.parametrize("y", [0.02, 0.04, 0.3])
def test_on_an_axis_through_the_middle_rounding_does_not_choose_the_quadrant(y: float) -> None:
    items = [
        placed("a", box(0.1, 0.08, 0.1), (-0.07 + y, y, 0.05), 0.3),
        placed("b", box(0.08, 0.06, 0.1), (0.01 + y, 0.1 + y, 0.05), 1.1),
        placed("c", ball(0.03), (y, -0.1 + y, 0.028)),
        placed("d", box(0.11, 0.1, 0.05), (0.02 + y, y, 0.024), 0.3),
    ]
    around = [[part(turned(item, quarters)) for item in items] for quarters in range(4)]
    assert len({(count_quarter_turns(parts) + quarters) % 4 for quarters, parts in enumerate(around)}) == 1


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_a_layout_turned_by_quarters_is_rectified_the_same(quarters: int) -> None:
    items = [
        tilted(placed("a", box(0.11, 0.08, 0.06), (0.0, 0.01, 0.033), 0.3), 0.6, -0.9),
        tilted(placed("b", box(0.09, 0.05, 0.13), (0.078, 0.022, 0.06), 1.2), -0.8, 0.4),
        placed("c", ball(0.03), (0.011, 0.017, 0.081), 0.4),
        placed("d", box(0.04, 0.07, 0.05), (-0.07, -0.03, 0.028), 2.0),
    ]
    result, again = rectified(items), rectified([turned(item, quarters) for item in items])
    assert np.abs(offsets(again) - offsets(result) @ quarter_turns(quarters).T).max() < 1e-5


@pytest.mark.parametrize("angle", [0.0, 0.4, np.pi / 4])
def test_the_centre_of_mass_of_a_composite_is_that_of_its_volumes(angle: float) -> None:
    tray = placed("tray", box(0.2, 0.2, 0.02), (0, 0, 0.01))
    pen = placed("pen", box(0.15, 0.008, 0.008), (0.05, 0, 0.024), angle, contained_in="tray")
    volumes = np.array([0.2 * 0.2 * 0.02, 0.15 * 0.008**2])
    truth = volumes @ np.array([tray.pose.position, pen.pose.position]) / volumes.sum()
    body = merge_rigid_parts([part(tray), part(pen)])
    assert np.abs(body.mass_center - truth).max() < 1e-9
    assert body.volume_m3 == pytest.approx(volumes.sum())


def test_ties_go_by_the_smallest_id_in_a_composite_and_are_reported_so() -> None:
    """Plates `z` (with `a` on it) and `m` are equally central."""
    items = [
        placed("z", box(0.1, 0.1, 0.02), (-0.045, 0, 0.01)),
        placed("a", box(0.02, 0.02, 0.02), (-0.045, 0, 0.031), contained_in="z"),
        placed("m", box(0.1, 0.1, 0.02), (0.045, 0, 0.01)),
    ]
    assert merge_rigid_parts([part(item) for item in items[:2]]).object_id == "a"
    assert rectified(items).groups == (((0, 1),), ((2,),))


def test_two_boxes_share_the_way_apart() -> None:
    items = [placed(name, box(0.1, 0.1, 0.1), (x, 0, 0.05)) for name, x in (("a", 0.0), ("b", 0.09))]
    moves = offsets(rectified(items))
    assert moves[1, 0] - moves[0, 0] == pytest.approx(0.01 + CONFIG.clearance_m, abs=1e-5)
    assert moves[0] == pytest.approx(-moves[1], abs=1e-5)


def test_the_way_apart_is_no_longer_than_the_overlap_even_for_flat_things() -> None:
    """Two plates on the table that overlap by 1 cm: the shortest way out is upward, but both stand."""
    items = [placed(name, box(0.2, 0.2, 0.005), (x, 0, 0.0025)) for name, x in (("a", 0.0), ("b", 0.19))]
    moves = offsets(rectified(items))
    assert np.abs(moves[:, 2]).max() < 1e-9
    assert moves[1, 0] - moves[0, 0] == pytest.approx(0.01 + CONFIG.clearance_m, abs=1e-5)


def test_a_small_tilt_of_what_stands_is_taken_out() -> None:
    item = tilted(placed("a", box(0.1, 0.06, 0.2), (0.1, 0.2, 0.1), 0.7), 1.5, -1.0)
    [moved] = rectified([item]).parts
    pose = moved.pose_now(item.pose)
    assert tilt_deg(pose.quaternion_wxyz) < 1e-6
    assert np.abs(pose.position - [0.1, 0.2, 0.1]).max() < 1e-9
    assert rotation_angle(pose.quaternion_wxyz, item.pose.quaternion_wxyz) < np.radians(2.0)


def test_a_thing_on_another_stays_on_it_and_is_let_down() -> None:
    items = [
        placed("table_book", box(0.2, 0.15, 0.03), (0, 0, 0.012)),
        tilted(placed("mug", box(0.07, 0.07, 0.09), (0.06, 0.02, 0.078)), 1.0),
    ]
    result = rectified(items)
    assert len(result.groups) == 1
    assert result.parts[1].lowest_now_m == pytest.approx(0.03 + CONFIG.clearance_m, abs=1e-4)
    assert np.abs(offsets(result)[:, :2]).max() < 1e-3


def test_what_leans_stays_leaning() -> None:
    """A board with one edge on the table and the other on a box: LCCR grounds it and pushes it out."""
    prop = placed("prop", box(0.1, 0.2, 0.1), (0, 0, 0.05))
    board = tilted(placed("board", box(0.24, 0.1, 0.008), (0.1225, 0.0, 0.0637)), 0.0, 30.0)
    support = read_support([part(board), part(prop)], CONFIG.contact_m)
    assert support.pairs == {(0, 1)}
    for noise in ((0.006, 0, 0), (-0.006, 0, 0.003), (0, 0.005, -0.003)):
        seen = replace(board, pose=replace(board.pose, position=board.pose.position + noise))
        result = rectified([seen, prop])
        leaning, box_ = result.parts
        assert smallest_gap([leaning, box_]) < CONFIG.clearance_m + 5e-4
        assert leaning.lowest_now_m < 5e-4
        assert 25.0 < tilt_deg(leaning.pose_now(seen.pose).quaternion_wxyz) < 35.0
        assert np.abs(offsets(result)).max() < 0.008


def make_carton_over_board(name: str, angle: float = -3.5, y: float = 0.0) -> list[PlacedObject]:
    """A carton over the rim of a board: that it lies on it shows only in a tilt beyond the noise."""
    board = placed(f"{name}_board", box(0.06, 0.2, 0.005), (0.062, y, 0.0025))
    height = 0.02 + 0.05 * np.sin(np.radians(abs(angle)))
    return [board, tilted(placed(name, box(0.1, 0.08, 0.04), (0.0, y, height)), 0.0, angle)]


@pytest.mark.parametrize("clearance_m", [CONFIG.clearance_m, 0.003])
@pytest.mark.parametrize(("angle", "leans"), [(-3.5, True), (-0.5, False)])
def test_what_could_stand_leans_where_it_moves_less_so(angle: float, leans: bool, clearance_m: float) -> None:
    items = make_carton_over_board("carton", angle)
    parts = [part(item) for item in items]
    assert not read_support(parts, CONFIG.contact_m).pairs
    result = rectify_jointly(parts, CONFIG.model_copy(update={"clearance_m": clearance_m}))
    assert smallest_gap(result.parts) >= clearance_m - 1e-6
    assert len(result.groups) == (1 if leans else 2)
    assert (tilt_deg(result.parts[1].pose_now(items[1].pose).quaternion_wxyz) > 2.5) == leans


def test_each_of_several_may_lean_whatever_they_are_called() -> None:
    """Each carton lies over two boards and leans on one: the other is not tried, and does not count as a trial."""
    for names in ("abcdef", "fedcba"):
        items: list[PlacedObject] = []
        for k, name in enumerate(names):
            board, carton = make_carton_over_board(name, y=0.205 * k)
            half = box(0.06, 0.095, 0.005)
            x, y, z = board.pose.position
            items += [placed(f"{name}_{side}", half, (x, y + aside, z)) for side, aside in enumerate((-0.05, 0.05))]
            items.append(carton)
        result = rectified(items)
        pairs = zip(result.parts[2::3], items[2::3], strict=True)
        assert all(tilt_deg(moved.pose_now(item.pose).quaternion_wxyz) > 2.5 for moved, item in pairs)


def test_what_carries_another_does_not_lean() -> None:
    """The same carton under a can: it may be seen tilted because of that."""
    board = placed("board", box(0.06, 0.2, 0.005), (0.062, 0, 0.0025))
    carton = tilted(placed("carton", box(0.1, 0.08, 0.04), (0.0, 0.0, 0.023)), 0.0, -3.5)
    can = placed("can", box(0.03, 0.03, 0.06), (0.0, 0.0, 0.074))
    result = rectified([board, carton, can])
    assert tilt_deg(result.parts[1].pose_now(carton.pose).quaternion_wxyz) < 0.1


@pytest.mark.parametrize("angle", [-30.0, 30.0])
def test_what_hangs_is_carried_by_what_it_touches(angle: float) -> None:
    """A tilted board in the air beside a box, to which it would fall or not."""
    prop = placed("prop", box(0.1, 0.1, 0.2), (0, 0, 0.1))
    board = tilted(placed("board", box(0.02, 0.1, 0.08), (0.09, 0, 0.1)), 0.0, angle)
    assert read_support([part(prop), part(board)], CONFIG.contact_m).pairs == {(1, 0)}


def test_of_two_in_one_place_the_one_that_rises_less_lies_on_the_other() -> None:
    """A rod through a plate that hovers: the rod need not rise by its length, as the plate would."""
    plate, rod = placed("plate", box(0.1, 0.1, 0.01), (0, 0, 0.025)), placed("rod", box(0.04, 0.04, 0.2), (0, 0, 0.1))
    assert read_support([part(plate), part(rod)], CONFIG.contact_m).pairs == {(1, 0)}


def test_what_hangs_stands_on_what_seemed_to_lie_on_it() -> None:
    """A ball noisily sunk into the bar below it, which has a carrier of its own."""
    post = placed("post", box(0.04, 0.04, 0.05), (-0.1, 0, 0.025))
    bar = placed("bar", box(0.24, 0.03, 0.02), (-0.005, 0, 0.0605))
    knob = placed("knob", box(0.05, 0.05, 0.025), (0.09, 0, 0.06))
    pairs = read_support([part(post), part(bar), part(knob)], CONFIG.contact_m).pairs
    assert pairs == {(1, 0), (2, 1)}


def test_a_ball_in_a_tray_goes_where_its_walls_are_not() -> None:
    floor = placed("tray", box(0.2, 0.2, 0.01), (0, 0, 0.005))
    fruit = placed("fruit", ball(0.03), (0.02, 0.0, 0.035), contained_in="tray")
    moved = rectified([floor, fruit])
    assert np.ptp(offsets(moved)[:, :2], axis=0).max() < 1e-9
    assert smallest_gap(moved.parts) >= CONFIG.clearance_m - 2e-6


def test_contents_turn_with_their_container() -> None:
    tray = tilted(placed("tray", box(0.2, 0.2, 0.02), (0, 0, 0.012)), 1.0)
    fruit = placed("fruit", box(0.03, 0.03, 0.03), (0.07, 0.0, 0.04), contained_in="tray")
    result = rectified([tray, fruit])
    assert result.groups == (((0, 1),),)
    first, second = result.parts
    assert first.turned_by == pytest.approx(second.turned_by)
    before = fruit.pose.position - tray.pose.position
    after = second.pose_now(fruit.pose).position - first.pose_now(tray.pose).position
    lift = np.array([0.0, 0.0, 0.002])
    assert np.linalg.norm(after - rotation_matrix(first.turned_by) @ before) < np.linalg.norm(lift)


def test_an_order_is_a_circle() -> None:
    assert is_order_kept(np.array([np.nan, 0.0, 1.0, 2.0]), np.array([np.nan, 3.0, -2.5, -1.0]))
    assert not is_order_kept(np.array([np.nan, 0.0, 1.0, 2.0]), np.array([np.nan, 0.0, 2.0, 1.0]))
    assert is_order_kept(np.array([np.nan, 0.0, 1.0, 1.0]), np.array([np.nan, 0.0, 1.2, 1.1]))
    assert is_order_kept(np.array([np.pi, 0.0, -np.pi, 0.0]), np.array([-np.pi, 1e-17, np.pi, -1e-17]))
    assert is_order_kept(np.array([np.nan]), np.array([np.nan]))


def test_the_stage_turns_poses_and_gives_the_same_bytes(tmp_path: Path) -> None:
    table = Table(np.zeros(2), np.ones(2), 0.0, (200, 200, 200), 0.0)
    items = (
        tilted(placed("b", box(0.1, 0.1, 0.1), (0.09, 0, 0.05), 0.2), 1.0),
        placed("a", box(0.1, 0.1, 0.1), (0, 0, 0.05), 0.7),
    )
    scene = PlacedObjects("scene", table, items, None)
    config = Config(rectify=CONFIG)
    first, second = (rectify(scene, config, make_rng(0, "scene", "rectify"), Services(tmp_path)) for _ in range(2))
    assert encode(first) == encode(second)
    assert isinstance(first, Done)
    layout = first.value
    assert tilt_deg(layout.poses[0].quaternion_wxyz) < 1e-6
    assert measure_piece_penetrations(layout.pieces, layout.poses, [1.0, 1.0]) == []
    assert measure_mesh_penetrations([item.mesh for item in items], layout.poses, [1.0, 1.0]) == []


@pytest.mark.parametrize("seed", range(6))
def test_noise_changes_nothing_about_who_carries_whom(seed: int) -> None:
    truth = [
        placed("book", box(0.22, 0.16, 0.03), (0, 0, 0.015)),
        placed("carton", box(0.1, 0.12, 0.06), (0.02, 0.0, 0.06)),
        placed("cup", box(0.06, 0.06, 0.08), (0.02, 0.01, 0.13)),
        placed("jar", box(0.08, 0.08, 0.12), (-0.155, 0.0, 0.06)),
        tilted(placed("board", box(0.24, 0.1, 0.008), (0.235, 0.0, 0.0637)), 0.0, 30.0),
        placed("prop", box(0.02, 0.2, 0.1), (0.153, 0.0, 0.05)),
    ]
    carried = find_piece_support([part(item).body.solids for item in truth])
    assert carried == {(1, 0), (2, 1), (4, 5)}
    result = rectified([noisy(item, np.random.default_rng([seed, k])) for k, item in enumerate(truth)])
    moved = [concatenate_solids([one.body.solids], [one.body.offset]) for one in result.parts]
    assert find_piece_support(moved) >= carried
    assert np.abs(offsets(result)).max() < 0.02


def noisy(item: PlacedObject, rng: np.random.Generator) -> PlacedObject:
    """As registration sees it."""
    turn = quaternion_from_rotation_vector(np.radians(rng.normal(0.0, (1.0, 1.0, 4.0))))
    position = item.pose.position + rng.normal(0.0, (0.007, 0.007, 0.003))
    seen = replace(item.pose, position=position, quaternion_wxyz=multiply_quaternions(turn, item.pose.quaternion_wxyz))
    return replace(item, pose=seen, scale=item.scale * float(np.exp(rng.normal(0.0, 0.03))))
