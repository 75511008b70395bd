"""Laws that both ways apart keep."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.config import RectifyConfig
from schemas.objects import PlacedObject
from tableverse_factory.stages.rectify.joint import rectify_jointly
from tableverse_factory.stages.rectify.lccr import RectificationResult, rectify_lccr
from tableverse_factory.stages.rectify.rigid_part import RigidPart
from tests.helpers.convex_layouts import (
    FAULTLESS,
    MILLIMETRES,
    ball,
    box,
    channel,
    layouts,
    offsets,
    part,
    placed,
    quarter_turns,
    smallest_gap,
    turned,
)
from tests.helpers.examples import scale_examples

CONFIG = RectifyConfig()
LAWS = settings(max_examples=scale_examples(30), deadline=None)
Method = Callable[[Sequence[RigidPart], RectifyConfig], RectificationResult]

pytestmark = pytest.mark.parametrize("method", [rectify_lccr, rectify_jointly])


def rectified(method: Method, items: Sequence[PlacedObject]) -> RectificationResult:
    return method([part(item) for item in items], CONFIG)


@pytest.mark.heavy
@LAWS
@given(items=layouts())
def test_the_result_is_free_by_the_clearance(method: Method, items: list[PlacedObject]) -> None:
    assert smallest_gap(rectified(method, items).parts) >= CONFIG.clearance_m - 2e-6


@pytest.mark.heavy
@LAWS
@given(items=layouts(), random=st.randoms(use_true_random=False))
def test_the_order_of_the_file_means_nothing(method: Method, items: list[PlacedObject], random: object) -> None:
    result = rectified(method, items)
    shuffled = list(items)
    random.shuffle(shuffled)  # type: ignore[attr-defined]
    again = rectified(method, shuffled)
    by_id = {item.object_id: moved for item, moved in zip(shuffled, again.parts, strict=True)}
    for item, moved in zip(items, result.parts, strict=True):
        assert (moved.body.offset == by_id[item.object_id].body.offset).all()
        assert (moved.turned_by == by_id[item.object_id].turned_by).all()
    names = [{items[i].object_id for entity in group for i in entity} for group in result.groups]
    assert names == [{shuffled[i].object_id for entity in group for i in entity} for group in again.groups]


@pytest.mark.heavy
@LAWS
@given(items=layouts(), quarters=st.integers(1, 3))
def test_a_layout_turned_by_quarters_is_rectified_the_same(
    method: Method, items: list[PlacedObject], quarters: int
) -> None:
    result, again = rectified(method, items), rectified(method, [turned(item, quarters) for item in items])
    assert np.abs(offsets(again) - offsets(result) @ quarter_turns(quarters).T).max() < 2e-6


@pytest.mark.heavy
@LAWS
@given(items=layouts())
def test_what_was_rectified_is_left_alone(method: Method, items: list[PlacedObject]) -> None:
    once = rectified(method, items)
    twice = method(once.parts, CONFIG)
    assert np.abs(offsets(twice) - offsets(once)).max() < (1e-4 if method is rectify_jointly else 1e-6)


BRIDGE = [
    placed("obj_000", ball(0.010), (0.088, 0.093, 0.008)),
    placed("obj_001", box(0.011, 0.067, 0.015), (0.106, 0.137, 0.040)),
    placed("obj_002", ball(0.010), (0.081, 0.122, 0.0)),
]


def test_a_bar_that_lies_aslant_on_two_balls_is_left_there(method: Method) -> None:
    once = rectified(method, BRIDGE)
    assert (offsets(method(once.parts, CONFIG)) == offsets(once)).all()


@pytest.mark.parametrize("nearer_m", [0.0, 3e-7, 5e-7, 6e-7, 7e-7, 1e-6])
@pytest.mark.parametrize("yaw", [0.0, 0.4, 1.1])
def test_nothing_hangs_beside_another(method: Method, yaw: float, nearer_m: float) -> None:
    beside = (0.1 + CONFIG.clearance_m - nearer_m) * np.array([np.cos(yaw), np.sin(yaw)])
    tower = placed("obj_000", box(0.1, 0.1, 0.4), (0.0, 0.0, 0.2), yaw)
    hanging = placed("obj_001", box(0.1, 0.1, 0.1), (*beside, 0.2), yaw)
    _, low = rectified(method, [tower, hanging]).parts
    assert low.lowest_now_m < 1e-3


@settings(max_examples=scale_examples(30), deadline=None)
@given(halves=st.lists(st.integers(5, 59).map(lambda n: n / 1000), min_size=1, max_size=9))
def test_a_free_layout_on_the_table_is_left_alone(method: Method, halves: list[float]) -> None:
    items = [
        placed(f"obj_{k}", box(2 * half, 2 * half, 2 * half), (0.12 * (k % 3), 0.12 * (k // 3), half))
        for k, half in enumerate(halves)
    ]
    result = rectified(method, items)
    assert np.abs(offsets(result)).max() < 1e-15
    assert all(moved.turned_by[0] == 1.0 for moved in result.parts)


@pytest.mark.parametrize("items", FAULTLESS.values(), ids=FAULTLESS)
def test_a_layout_without_a_fault_is_left_alone(method: Method, items: list[PlacedObject]) -> None:
    result = rectified(method, items)
    assert not offsets(result).any()
    assert all(moved.turned_by[0] == 1.0 for moved in result.parts)
    assert sorted(i for group in result.groups for entity in group for i in entity) == list(range(len(items)))


def test_a_stack_with_its_gap_is_left_alone(method: Method) -> None:
    stack = [placed("a", box(0.1, 0.1, 0.1), (0, 0, 0.05)), placed("b", box(0.04, 0.04, 0.04), (0.01, 0, 0.1205))]
    result = rectified(method, stack)
    assert result.groups == (((0,), (1,)),)
    assert np.abs(offsets(result)).max() < 1e-15


@pytest.mark.heavy
@LAWS
@given(
    where=st.lists(st.tuples(MILLIMETRES, MILLIMETRES, st.floats(-3.0, 3.0)), min_size=2, max_size=3),
    filled=st.booleans(),
)
def test_things_of_several_pieces_and_their_contents_end_free(
    method: Method, where: list[tuple[float, float, float]], filled: bool
) -> None:
    parts = [channel(f"c_{k}", (x, y, 0.0), angle) for k, (x, y, angle) in enumerate(where)]
    x, y, _ = where[0]
    content = placed("egg", ball(0.02), (x, y, 0.025), contained_in="c_0" if filled else None)
    assert smallest_gap(method([*parts, part(content)], CONFIG).parts) >= CONFIG.clearance_m - 2e-6


def test_what_a_mesh_sticks_out_of_its_pieces_is_left_room_for(method: Method) -> None:
    items = [placed("a", box(0.1, 0.1, 0.1), (0, 0, 0.05)), placed("b", box(0.1, 0.1, 0.1), (0.09, 0, 0.05))]
    result = method([part(items[0], 0.001), part(items[1], 0.002)], CONFIG)
    assert abs(np.diff(offsets(result)[:, 0])[0]) == pytest.approx(0.01 + 0.003 + CONFIG.clearance_m, abs=1e-5)


@pytest.mark.heavy
def test_many_objects_in_one_place_end_free(method: Method) -> None:
    items = [placed(f"obj_{k:03d}", box(0.05, 0.05, 0.05 + 0.001 * k), (0, 0, 0), 0.1 * k) for k in range(8)]
    assert smallest_gap(rectified(method, items).parts) >= CONFIG.clearance_m - 2e-6


def test_an_object_inside_a_solid_comes_out(method: Method) -> None:
    inside = [placed("a", box(0.2, 0.2, 0.2), (0, 0, 0.1)), placed("b", ball(0.02), (0.01, 0, 0.1))]
    assert smallest_gap(rectified(method, inside).parts) >= CONFIG.clearance_m - 2e-6
