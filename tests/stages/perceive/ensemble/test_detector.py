"""The detector `ensemble`: which of two answers a group gets, and that what it takes overlaps nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done
from tableverse_factory.models.services import Services
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures
from tableverse_factory.stages.observe.observe import observe
from tableverse_factory.stages.perceive.base.interfaces import Candidate, DetectionResult
from tableverse_factory.stages.perceive.depth_segmenter.segment import to_detections
from tableverse_factory.stages.perceive.ensemble.detector import (
    Comparison,
    _choose_answers,
    _merge_answers,
    compare_answers,
    contain_as,
    detect_with_ensemble,
    find_bent_table,
    group_objects,
    prefer_fused,
    prefer_net,
)
from tableverse_factory.stages.perceive.ensemble.fused import find_openings
from tableverse_factory.stages.perceive.perceive import choose_detector
from tableverse_factory.stages.perceive.table import find_table
from tests.helpers.tabletop_views import Box, camera_above, look

SHAPE = (80, 120)
ONE = np.zeros(SHAPE, dtype=np.int32)
ONE[20:60, 20:100] = 1
EIGHT = ONE.copy()
for part in range(1, 8):
    EIGHT[20:60, 20 + 10 * part : 100] = part + 1
SEAMS = tuple(np.s_[20:60, column - 2 : column + 2] for column in range(30, 100, 10))


def draw_boundary(*lines: tuple[slice, slice]) -> np.ndarray:
    """Draw probable boundaries around the whole, and along lines."""
    boundary = np.full(SHAPE, 0.02, dtype=np.float32)
    boundary[19:61, 19:101] = 0.95
    boundary[22:58, 22:98] = 0.02
    for line in lines:
        boundary[line] = 0.95
    return boundary


READ = np.zeros(SHAPE, dtype=bool)


def prefers_fused(first: np.ndarray, second: np.ndarray, boundary: np.ndarray) -> bool:
    return prefer_fused(compare_answers([first, second], boundary, READ))


@pytest.mark.parametrize(
    ("first", "second", "boundary", "second_wins"),
    [
        (ONE, EIGHT, draw_boundary(*SEAMS), True),
        (EIGHT, ONE, draw_boundary(), True),
        (EIGHT, ONE, draw_boundary(*SEAMS), False),
        (ONE, EIGHT, draw_boundary(), False),
        (EIGHT, EIGHT, draw_boundary(), False),
        (ONE, np.zeros_like(ONE), draw_boundary(), False),
    ],
    ids=["seams are seen", "no seam is seen", "seams stay", "nothing to part", "both alike", "one sees nothing"],
)
def test_the_answer_whose_borders_are_seen_is_taken(first, second, boundary, second_wins):
    assert prefers_fused(first, second, boundary) is second_wins


def test_a_seam_that_is_half_seen_parts_but_joins_nothing() -> None:
    """Depth knows no seam of two things that touch; one that it knows is not given up for half a reason."""
    halves = np.where((ONE > 0) & (np.arange(SHAPE[1]) >= 60), 2, ONE).astype(np.int32)
    boundary = draw_boundary()
    boundary[20:60, 58:62] = 0.6
    assert prefers_fused(ONE, halves, boundary)
    boundary[20:60, 58:62] = 0.4
    assert not prefers_fused(halves, ONE, boundary)


def test_an_answer_of_more_objects_may_explain_the_boundaries_less_well() -> None:
    halves = np.where((ONE > 0) & (np.arange(SHAPE[1]) >= 60), 2, ONE).astype(np.int32)
    boundary = draw_boundary()
    boundary[20:60, 58:62] = 0.3  # a seam that is improbable, but not impossible
    assert prefers_fused(ONE, halves, boundary)
    boundary[20:60, 58:62] = 0.02
    assert not prefers_fused(ONE, halves, boundary)


def test_an_outline_is_taken_from_both_sooner_than_a_way_to_part_objects() -> None:
    """Where each has one object a small gain decides; where they part several, it does not."""
    boundary = draw_boundary()
    narrow = np.where(np.arange(SHAPE[1]) < 92, ONE, 0).astype(np.int32)
    boundary[18:62, 86:98] = 0.5
    assert prefers_fused(narrow, ONE, boundary)
    halves, wider = (np.where((each > 0) & (np.arange(SHAPE[1]) >= 60), 2, each) for each in (narrow, ONE))
    assert not prefers_fused(halves, wider, boundary)


@pytest.mark.parametrize(
    ("counts", "gain", "unread", "taken"),
    [
        ((0, 1), 0.25, 0.0, True),
        ((0, 1), 0.15, 0.0, False),
        ((2, 1), 0.05, 0.15, True),
        ((2, 3), 0.9, 0.05, False),
        ((2, 1), -0.05, 0.15, False),
        ((2, 0), 0.05, 0.9, False),
        ((1, 2), 0.9, 0.9, False),
    ],
)
def test_the_net_alone_adds_objects_and_decides_of_several_where_a_sensor_reads_little(
    counts: tuple[int, int], gain: float, unread: float, taken: bool
) -> None:
    assert prefer_net(Comparison(counts, gain, unread)) is taken


def test_the_share_without_a_reading_is_that_of_the_group() -> None:
    unread = np.arange(SHAPE[1]) < np.full(SHAPE, 40)
    assert compare_answers([ONE, EIGHT], draw_boundary(), unread).unread == pytest.approx(0.25)
    assert compare_answers([ONE, EIGHT], draw_boundary(), unread).counts == (1, 8)


def test_objects_that_overlap_are_one_group_and_neighbours_are_not() -> None:
    first = np.array([[1, 1, 1, 2, 2, 2, 2, 0, 3, 0]], dtype=np.int32)
    second = np.array([[1, 1, 1, 1, 3, 3, 2, 2, 0, 4]], dtype=np.int32)  # a quarter of 1 is too little
    of_first, of_second = group_objects(first, second)
    assert of_first[0] == of_second[0] == 0
    assert of_first[1] == of_second[1]
    assert of_first[2] == of_second[3] == of_second[2]
    assert len({of_first[1], of_first[2], of_first[3], of_second[4]}) == 4
    of_first, of_second = group_objects(first, second, [(3, 1)], [(4, 2)])  # contents stay with what holds them
    assert of_first[1] == of_first[3]
    assert of_second[4] == of_second[2] != of_second[1]
    nothing = group_objects(np.zeros_like(first), np.zeros_like(first))
    assert [each.tolist() for each in nothing] == [[0], [0]]


def test_ids_without_pixels_have_groups_too() -> None:
    first, second = np.array([[1, 1, 0, 3]], dtype=np.int32), np.array([[0, 0, 0, 1]], dtype=np.int32)
    of_first, of_second = group_objects(first, second, [(5, 1)])
    assert of_first[5] == of_first[1] != of_first[3] == of_second[1]
    assert len(set(of_first[1:].tolist())) == 4


BOX = (0.0, 0.0, 1.0, 1.0)


def test_objects_lie_in_one_another_as_the_same_pixels_do_in_the_other_answer() -> None:
    """A can in a bowl on a tray, which the other answer numbers otherwise; and a pair that only that answer has."""
    known = DetectionResult(
        tuple(Candidate("object", 1.0, BOX, k, holder) for k, holder in ((1, None), (2, 0), (3, 1), (4, 0), (5, 3))),
        ids=np.array([[1, 1, 1, 2, 2, 2, 3, 3, 3, 4, 4, 5, 0, 0]], dtype=np.int32),
    )
    ids = np.array([[7, 7, 0, 5, 5, 5, 6, 6, 5, 2, 2, 2, 3, 4]], dtype=np.int32)
    said = ((6, None), (5, None), (2, 0), (7, None), (4, 5), (3, None))  # 2 in 6, and 4 in 3
    answer = DetectionResult(tuple(Candidate("object", 1.0, BOX, k, holder) for k, holder in said), ids=ids)
    found = contain_as(known, answer)
    assert found.ids is not None
    assert [candidate.instance for candidate in found.candidates] == [1, 2, 3, 4, 5, 6]
    before = {candidate.instance: int(ids[found.ids == candidate.instance][0]) for candidate in found.candidates}
    holders = [None if c.container is None else found.candidates[c.container].instance for c in found.candidates]
    told = {before[k]: None if holder is None else before[holder] for k, holder in enumerate(holders, start=1)}
    assert told == {7: None, 5: 7, 6: 5, 2: 7, 3: None, 4: 3}
    assert all(c.container is None or c.container < k for k, c in enumerate(found.candidates))


def test_an_object_that_swallowed_a_content_does_not_lie_in_its_bowl() -> None:
    known = DetectionResult(
        tuple(Candidate("object", 1.0, BOX, k, holder) for k, holder in ((1, None), (2, 0))),
        ids=np.array([[1, 1, 1, 2, 0, 0, 0]], dtype=np.int32),
    )
    answer = DetectionResult(
        tuple(Candidate("object", 1.0, BOX, k) for k in (1, 2)), ids=np.array([[1, 1, 1, 2, 2, 2, 2]], dtype=np.int32)
    )
    assert [candidate.container for candidate in contain_as(known, answer).candidates] == [None, None]


def merge(
    ids: list[list[int]], groups: list[list[int]], candidates: list[list[Candidate]], takes_second: list[bool]
) -> DetectionResult:
    """Merge two answers about a picture of one row."""
    rows = [np.array([own], dtype=np.int32) for own in ids]
    answers = [DetectionResult(tuple(each), ids=own) for each, own in zip(candidates, rows, strict=True)]
    numbers = [np.array([own], dtype=np.int32) for own in groups]
    return _merge_answers(answers, rows, numbers, np.array(takes_second))


def test_every_pixel_comes_from_the_answer_of_its_group_and_containers_stay() -> None:
    """The second answer's box lies partly on the first one's cup, which stays, as does the spoon in it."""
    first = [Candidate(name, 1.0, BOX, k) for k, name in enumerate(("cup", "spoon", "gone"), start=1)]
    second = [Candidate(name, 1.0, BOX, k) for k, name in enumerate(("lost", "lid", "box"), start=1)]
    merged = merge(
        [[2, 1, 1, 0, 3, 3, 0], [1, 1, 3, 0, 3, 2, 2]],
        [[1, 1, 1, 0, 2, 2, 0], [1, 1, 2, 0, 2, 2, 2]],
        [
            [first[0], replace(first[1], container=0), first[2]],
            [second[0], second[1], replace(second[2], container=0)],
        ],
        [False, False, True],
    )
    assert merged.ids is not None
    assert merged.ids.tolist() == [[2, 1, 1, 0, 4, 3, 3]]
    told = [(item.label, item.instance, item.container, item.box) for item in merged.candidates]
    assert told == [
        ("cup", 1, None, (1.0, 0.0, 3.0, 1.0)),
        ("spoon", 2, 0, (0.0, 0.0, 1.0, 1.0)),
        ("lid", 3, None, (5.0, 0.0, 7.0, 1.0)),
        ("box", 4, None, (4.0, 0.0, 5.0, 1.0)),
    ]


def test_a_sliver_of_an_object_is_none() -> None:
    candidates = [[Candidate("box", 1.0, BOX, 1)], [Candidate("jug", 1.0, BOX, 1)]]
    merged = merge(
        [[1, 1, 1, 0, 0], [0, 1, 1, 1, 0]], [[1, 1, 1, 0, 0], [0, 2, 2, 2, 0]], candidates, [False, False, True]
    )
    assert [item.label for item in merged.candidates] == ["box"]


@pytest.mark.parametrize(("bend", "chosen"), [(0.0, "ensemble"), (0.015, "picture")])
def test_without_the_depth_of_a_sensor_there_is_nothing_to_choose_from(bend: float, chosen: str) -> None:
    config = Config.model_validate({"perceive": {"detector": "ensemble"}})
    assert choose_detector(replace(look([])[0], bend=bend), config.perceive) == chosen


@pytest.mark.heavy
@pytest.mark.parametrize("count", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_ids_are_dense_and_containers_come_first(tmp_path: Path, count: int) -> None:
    services, config = Services(Path()), Config()
    for folder in synthesize_captures(tmp_path / "captures", count, 11):
        row = ImageRow(scene_id="x", kind=SceneKind.CAPTURE, uri=str(folder))
        seen = observe(row, config, np.random.default_rng(0), services)
        assert isinstance(seen, Done), seen
        view = find_table(seen.value, np.random.default_rng(0))
        found = detect_with_ensemble(view, config, services)
        assert found.ids is not None
        assert set(np.unique(found.ids)) == {*range(len(found.candidates) + 1)}
        for index, candidate in enumerate(found.candidates):
            assert candidate.instance == index + 1
            assert candidate.container is None or candidate.container < index


@pytest.mark.parametrize(("behind_m", "is_opening"), [(0.08, True), (0.002, False)], ids=["a handle", "a plate"])
def test_the_table_is_seen_through_a_handle_and_not_through_a_plate(behind_m: float, is_opening: bool) -> None:
    """A ring stands, half of whose inner edge the sensor lost; only a step in depth tells what lies within."""
    depth = np.full((240, 320), 0.9 + behind_m, dtype=np.float32)
    rows, columns = np.indices(depth.shape)
    away = np.hypot(rows - 120, columns - 160)
    standing = (away > 15) & (away < 25)
    depth[standing] = 0.9
    depth[(away > 13) & (away <= 15) & (columns < 160)] = 0.0
    found = find_openings(standing, depth)
    assert found[away < 13].all() == found.any() == is_opening
    assert not found[away > 15].any()


@pytest.mark.parametrize(
    ("height", "probability", "is_table"),
    [
        pytest.param(0.012, 1.0, True, id="table that the sensor bends"),
        pytest.param(0.012, 0.8, False, id="a book in the colour of the table"),
        pytest.param(0.08, 1.0, False, id="a block of the table's wood"),
    ],
)
def test_what_rises_a_little_and_looks_like_table_is_table(height, probability, is_table):
    seen, ids = look([Box(-0.15, 0.0, (0.1, 0.1, 0.1)), Box(0.15, 0.0, (0.1, 0.1, height))], camera_above(0.6, 0.7))
    view = find_table(seen, np.random.default_rng(0))
    things = np.maximum(ids - 1, 0).astype(np.int32)
    table_probability = np.where(things == 1, 0.0, np.where(things == 2, probability, 1.0)).astype(np.float32)
    assert (find_bent_table(things, view, table_probability) == ((things == 2) & is_table)).all()


def test_without_objects_no_table_is_taken_for_one():
    seen, ids = look([Box(0.0, 0.0, (0.1, 0.1, 0.1))], camera_above(0.6, 0.7))
    view = find_table(seen, np.random.default_rng(0))
    assert not find_bent_table(np.zeros_like(ids), view, np.ones(ids.shape, np.float32)).any()


def test_an_object_on_bent_table_that_the_net_alone_sees_is_kept():
    bent, thing = np.zeros(SHAPE, np.int32), np.zeros(SHAPE, np.int32)
    bent[5:75, 5:115] = thing[30:50, 50:70] = 1
    boundary = np.full(SHAPE, 0.02, dtype=np.float32)
    boundary[29:51, 49:71] = 0.95
    boundary[32:48, 52:68] = 0.02
    by_depth, seen = (to_detections(ids, {}) for ids in (bent, thing))
    without = replace(by_depth, ids=np.zeros_like(bent))
    assert (_choose_answers(without, seen, boundary, READ, prefer_net).ids == thing).all()
    assert not (_choose_answers(by_depth, seen, boundary, READ, prefer_net).ids == thing).all()
