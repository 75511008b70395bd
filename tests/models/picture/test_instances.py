"""Objects of predictions made up on paper: what is cut at a boundary, what is merged, and how they are numbered."""

from dataclasses import replace

import numpy as np
import pytest

from schemas.geometry import Camera
from tableverse_factory.models.picture.instances import (
    MIN_OBJECT_PX,
    label_standing_parts,
    segment_prediction,
    upsample_ids,
)
from tableverse_factory.models.picture.predict import OBJECT, OTHER, TABLE, PicturePrediction

ROWS, COLUMNS = 96, 128
LEFT, RIGHT = (slice(30, 60), slice(30, 60)), (slice(30, 60), slice(60, 90))  # they touch
LARGE = (slice(10, 50), slice(5, 55))
UNLIKELY = -1.0  # logit that two pixels are of one object: neither votes nor boundaries are overruled


def make_prediction(*things: tuple[slice, slice]) -> PicturePrediction:
    """Things on a table parallel to the picture, all at one distance; each votes for its middle."""
    label, votes = np.zeros((3, ROWS, COLUMNS), np.float32), np.zeros((2, ROWS, COLUMNS), np.float32)
    label[TABLE] = 1.0
    for thing in things:
        label[:, *thing] = np.eye(3, dtype=np.float32)[OBJECT][:, None, None]
        vote_for(votes, thing, *(0.5 * (part.start + part.stop - 1) for part in thing))
    return PicturePrediction(
        Camera(120.0, 120.0, 63.5, 47.5, COLUMNS, ROWS),
        np.ones((ROWS, COLUMNS), np.float32),
        label,
        votes,
        np.zeros((ROWS, COLUMNS), np.float32),
        np.full((6, ROWS, COLUMNS), UNLIKELY, np.float32),
        np.array([0.0, 0.0, -1.0]),
        1.0,
        0.9,
        0.1,
    )


def vote_for(votes: np.ndarray, thing: tuple[slice, slice], row: float, column: float) -> None:
    rows, columns = np.mgrid[thing]
    votes[:, *thing] = np.stack([column - columns, row - rows])


def draw_boundary(found: PicturePrediction, *columns: int) -> PicturePrediction:
    boundary = found.boundary.copy()
    boundary[30:60, list(columns)] = 1.0
    return replace(found, boundary=boundary)


def segment(found: PicturePrediction) -> np.ndarray:
    return segment_prediction(found, (ROWS, COLUMNS))


def vote_in_halves(spread_px: float) -> PicturePrediction:
    """One box of 30 x 60 whose halves vote for two middles, `spread_px` apart."""
    found = make_prediction((slice(30, 60), slice(30, 90)))
    votes = found.votes.copy()
    vote_for(votes, LEFT, 44.5, 59.5 - spread_px / 2)
    vote_for(votes, RIGHT, 44.5, 59.5 + spread_px / 2)
    return replace(found, votes=votes)


def test_two_boxes_with_a_boundary_between_them_stay_apart() -> None:
    ids = segment(draw_boundary(make_prediction(LEFT, RIGHT), 59, 60))
    assert np.unique(ids[LEFT]).tolist() == [ids[40, 40]]
    assert np.unique(ids[RIGHT]).tolist() == [ids[40, 80]]
    assert {ids[40, 40], ids[40, 80]} == {1, 2}


def test_the_votes_alone_keep_two_boxes_apart_whose_middles_are_far() -> None:
    ids = segment(make_prediction(LEFT, RIGHT))
    assert {*np.unique(ids[LEFT])} | {*np.unique(ids[RIGHT])} == {1, 2}
    assert ids[40, 40] != ids[40, 80]


def test_a_boundary_alone_separates_what_votes_for_one_middle() -> None:
    found = make_prediction((slice(30, 60), slice(30, 90)))
    assert segment(found).max() == 1
    assert segment(draw_boundary(found, 59, 60)).max() == 2


def test_one_box_with_two_peaks_of_votes_and_no_boundary_is_one() -> None:
    votes = vote_in_halves(14.0)
    rng = np.random.default_rng(0)
    found = replace(votes, votes=(votes.votes + rng.normal(0.0, 4.0, votes.votes.shape)).astype(np.float32))
    ids = segment(found)
    assert np.unique(ids[30:60, 30:90]).tolist() == [1]
    assert segment(draw_boundary(found, 58, 59, 60, 61)).max() == 2, "the boundary forbids what the votes permit"


def test_a_crease_between_two_peaks_separates() -> None:
    """The same votes on two surfaces, one far before the other."""
    votes = vote_in_halves(14.0)
    rng = np.random.default_rng(0)
    found = replace(votes, votes=(votes.votes + rng.normal(0.0, 4.0, votes.votes.shape)).astype(np.float32))
    depth = found.depth.copy()
    depth[:, 60:] = 1.5
    ids = segment(replace(found, depth=depth))
    assert ids[40, 40] != ids[40, 80]


def test_pixels_that_belong_together_join_what_print_cut_and_others_keep_apart_what_votes_would_join() -> None:
    halves = draw_boundary(vote_in_halves(30.0), 58, 59, 60, 61)
    assert segment(halves).max() == 2
    assert segment(replace(halves, affinity=halves.affinity + np.float32(3.0))).max() == 1
    votes = vote_in_halves(14.0)
    rng = np.random.default_rng(0)
    found = replace(votes, votes=(votes.votes + rng.normal(0.0, 4.0, votes.votes.shape)).astype(np.float32))
    assert segment(found).max() == 1
    assert segment(replace(found, affinity=found.affinity - np.float32(3.0))).max() == 2


def test_what_is_probably_one_object_is_joined_where_the_surface_goes_on_and_nowhere_else() -> None:
    halves = draw_boundary(vote_in_halves(30.0), 58, 59, 60, 61)
    even = replace(halves, affinity=np.zeros_like(halves.affinity))
    assert segment(even).max() == 1
    depth = even.depth.copy()
    depth[:, 60:] = 1.5
    assert segment(replace(even, depth=depth)).max() == 2


@pytest.mark.parametrize(("spread_px", "count"), [(0.0, 1), (25.0, 2)])
def test_a_handle_of_the_same_middle_is_joined_where_its_depth_steps(spread_px: float, count: int) -> None:
    found = draw_boundary(vote_in_halves(spread_px), 59, 60)
    depth = found.depth.copy()
    depth[:, 60:] = 1.2
    found = replace(found, depth=depth, affinity=np.full_like(found.affinity, -0.5))
    assert segment(found).max() == count


def test_ids_are_dense_from_one_the_largest_first() -> None:
    small, tiny = (slice(60, 80), slice(70, 100)), (slice(20, 32), slice(100, 112))
    ids = segment(make_prediction(tiny, small, LARGE))
    sizes = np.bincount(ids.ravel())
    assert sizes[1:].tolist() == [2000, 600, 144]
    assert [int(ids[part][0, 0]) for part in (LARGE, small, tiny)] == [1, 2, 3]
    assert ids.dtype == np.int32


def test_where_no_object_is_there_is_none() -> None:
    assert not segment(make_prediction()).any()
    assert segment_prediction(make_prediction(), (480, 640)).shape == (480, 640)


def test_objects_are_found_where_the_label_says_and_nowhere_else() -> None:
    ids = segment(make_prediction(LEFT, LARGE))
    wanted = np.zeros(ids.shape, bool)
    wanted[LEFT] = wanted[LARGE] = True
    np.testing.assert_array_equal(ids > 0, wanted)


def test_specks_are_no_objects() -> None:
    side = int(MIN_OBJECT_PX**0.5)
    assert side * side < MIN_OBJECT_PX
    assert not segment(make_prediction((slice(20, 20 + side), slice(20, 20 + side)))).any()
    assert segment(make_prediction((slice(20, 22 + side), slice(20, 22 + side)))).any()


@pytest.mark.parametrize("factor", [2, 5])
def test_ids_keep_their_places_at_another_size(factor: int) -> None:
    ids = segment(make_prediction(LEFT, LARGE))
    large = upsample_ids(ids, (factor * ROWS, factor * COLUMNS))
    plain = np.kron(ids, np.ones((factor, factor), np.int32))
    assert {*np.unique(large)} == {*np.unique(ids)}
    assert (large == plain).mean() > 0.98
    np.testing.assert_array_equal(upsample_ids(ids, ids.shape), ids)


def test_a_chain_of_scraps_does_not_join_what_its_own_border_keeps_apart() -> None:
    """A cup, its saucer and a shadow between them that agrees with both."""
    found = draw_boundary(make_prediction(LEFT, RIGHT, (slice(60, 70), slice(50, 70))), 59, 60)
    affinity = np.zeros_like(found.affinity)
    affinity[0::2, :60] = -4.0  # to the right, across the border of cup and saucer
    affinity[1::2] = 4.0  # downward, from both to the shadow
    ids = segment(replace(found, affinity=affinity))
    assert ids[40, 35] != ids[40, 80]


def test_the_visible_parts_of_a_plate_are_joined_around_what_stands_on_it() -> None:
    plate, cup = (slice(20, 70), slice(20, 110)), (slice(20, 70), slice(50, 80))
    found = make_prediction(plate)
    votes, depth, boundary = found.votes.copy(), found.depth.copy(), found.boundary.copy()
    vote_for(votes, cup, 44.5, 62.0)
    depth[cup] = 0.8
    boundary[20:70, [49, 50, 79, 80]] = 1.0
    hidden = replace(found, votes=votes, depth=depth, boundary=boundary, affinity=found.affinity - np.float32(3.0))
    ids = segment(hidden)
    assert ids[40, 30] == ids[40, 100] != ids[40, 65]
    two = make_prediction((slice(20, 70), slice(20, 50)), (slice(20, 70), slice(80, 110)))
    assert segment(two).max() == 2, "whole things that vote for their own middles are two"


def test_what_is_unlikely_to_be_an_object_is_none() -> None:
    found = make_prediction(LARGE)
    label = found.label.copy()
    label[:, *LARGE] = np.array([0.3, 0.25, 0.45], np.float32)[:, None, None]
    assert segment(replace(found, label=label)).max() == 0


CHUCK = (slice(30, 76), slice(40, 70))  # a metre away; it begins over the horizon, in the middle row
WALL = (slice(0, 48), slice(0, COLUMNS))  # behind the table's far end
HALF_ABOVE = (slice(18, 76), slice(40, 70))


def look_level(part: tuple[slice, slice], wall_m: float, doubt: float = 0.15, around: int = TABLE) -> PicturePrediction:
    """A level look over a table 0.3 m below: a part that the net takes for the room, with a doubt, before a wall."""
    kinds = np.eye(3, dtype=np.float32)[:, :, None, None]
    rows = np.arange(ROWS)[:, None]
    label = np.repeat(np.where(rows < WALL[0].stop, kinds[OTHER], kinds[TABLE]), COLUMNS, axis=2)
    depth = np.repeat(np.where(rows < WALL[0].stop, wall_m, 36.0 / np.maximum(rows - 47.5, 0.5)), COLUMNS, axis=1)
    frame = tuple(slice(its.start - 5, its.stop + 5) for its in part)
    label[:, *frame] = label[:, *frame] if around == TABLE else kinds[around]
    label[:, *part] = (1.0 - doubt) * kinds[OTHER] + doubt * kinds[OBJECT]
    depth[part] = 1.0
    made = replace(make_prediction(), label=label, depth=depth.astype(np.float32))
    return replace(made, normal=np.array([0.0, -1.0, 0.0]), distance_m=0.3)


@pytest.mark.parametrize(
    ("part", "found", "is_object"),
    [
        pytest.param(CHUCK, {"wall_m": 3.0}, True, id="before a wall that is far away"),
        pytest.param(CHUCK, {"wall_m": 1.12}, True, id="before a near one"),
        pytest.param(CHUCK, {"wall_m": 1.02}, False, id="it continues in the wall"),
        pytest.param(CHUCK, {"wall_m": 3.0, "doubt": 0.05}, False, id="the net is sure"),
        pytest.param(HALF_ABOVE, {"wall_m": 3.0}, False, id="mostly before the wall"),
        pytest.param(CHUCK, {"wall_m": 3.0, "around": OBJECT}, False, id="a pocket in an object"),
        pytest.param((slice(30, 76), slice(2, 32)), {"wall_m": 3.0}, False, id="two pixels from the border, as an arm"),
        pytest.param((slice(60, 68), slice(40, 50)), {"wall_m": 3.0}, False, id="a speck"),
    ],
)
def test_a_part_that_stands_on_the_table_is_an_object_though_the_net_takes_it_for_the_room(
    part, found, is_object
) -> None:
    asked = look_level(part, **found)
    said = label_standing_parts(asked)
    changed = (said.label != asked.label).any(axis=0)
    shown = np.zeros(changed.shape, dtype=bool)
    shown[part] = is_object
    np.testing.assert_array_equal(changed, shown)
    ids = segment(said)
    assert (ids[part] > 0).all() == is_object
    assert (ids[part] == ids[part][0, 0]).all(), "one object"


def test_a_hole_in_what_is_called_table_is_no_object() -> None:
    found = make_prediction(LEFT)
    label = found.label.copy()
    label[:, *LEFT] = np.array([0.85, 0.0, 0.15])[:, None, None]
    for distance_m, count in ((0.99, 0), (0.95, 1)):
        depth = found.depth.copy()
        depth[LEFT] = distance_m
        assert segment(label_standing_parts(replace(found, label=label, depth=depth))).max() == count


def test_where_the_room_fills_the_picture_nothing_is_added() -> None:
    found = make_prediction((slice(0, ROWS), slice(0, COLUMNS)))
    label = np.zeros_like(found.label)
    label[OTHER] = 1.0
    room = replace(found, label=label, depth=0.5 * found.depth)
    assert segment(label_standing_parts(room)).max() == 0
