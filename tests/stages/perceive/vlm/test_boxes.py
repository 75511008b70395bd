"""Boxes as models write them: whatever the spelling, order and unit, the same box; and never one out of the picture."""

import json
import math
from contextlib import suppress

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.detection import Detection, Detections
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.stages.perceive.vlm.boxes import (
    MIN_SIDE_PX,
    SLACK,
    THOUSANDTHS,
    infer_scale,
    normalise_box,
    read_corners,
)
from tableverse_factory.stages.perceive.vlm.parse_answer import parse_detections
from tableverse_factory.stages.perceive.vlm.postprocess import apply_rules

SENT = (1536, 1152)
LOW, HIGH = st.integers(0, 450), st.integers(550, 1000)
BOXES = st.tuples(LOW, LOW, HIGH, HIGH)
ANY_NUMBER = st.one_of(st.floats(), st.integers(-(10**30), 10**30))
ANYTHING = st.recursive(
    st.one_of(st.none(), st.booleans(), ANY_NUMBER, st.text(max_size=30)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=5), st.dictionaries(st.sampled_from(["xmin", "bbox", "x1", "y"]), inner, max_size=4)
    ),
    max_leaves=12,
)


def spelled(box) -> list:
    """One box in all spellings that models use, for an order of x first."""
    a, b, c, d = box
    return [
        {"bbox_xyxy": [a, b, c, d]},
        {"bbox": [str(a), f" {b}.0", c, float(d)]},
        {"bbox": f"<bbox>{a} {b} {c} {d}</bbox>"},
        {"bbox_xyxy": f"[{a}, {b}, {c}, {d}]"},
        {"bbox_2d": [[a, b, c, d]]},
        {"box": [[a, b], [c, d]]},
        {"bbox": {"xmin": a, "ymin": b, "xmax": c, "ymax": d}},
        {"bbox": {"x1": a, "y1": b, "x2": c, "y2": d, "confidence": 1}},
        {"box_2d": {"left": a, "top": b, "right": c, "bottom": d}},
        {"bbox_xyxy": None, "bbox": [a, b, c, d]},
        [a, b, c, d],
    ]


@given(BOXES)
def test_every_spelling_gives_the_same_box(box):
    assert {read_corners(entry, "xyxy") for entry in spelled(box)} == {tuple(map(float, box))}


@given(BOXES)
def test_numbers_are_taken_in_the_order_that_was_asked_for_unless_the_answer_says_which(box):
    x0, y0, x1, y1 = map(float, box)
    swapped = [box[1], box[0], box[3], box[2]]
    for entry in ({"box_2d": swapped}, {"bbox": swapped}, {"box_2d": f"{swapped}"}, {"box": [swapped]}, swapped):
        assert read_corners(entry, "yxyx") == (x0, y0, x1, y1)
    for named in ({"bbox_xyxy": list(box)}, {"bbox": {"xmin": x0, "ymin": y0, "xmax": x1, "ymax": y1}}):
        assert read_corners(named, "yxyx") == (x0, y0, x1, y1)
    assert read_corners({"bbox_yxyx": swapped}, "xyxy") == (x0, y0, x1, y1)


@pytest.mark.heavy
@given(ANYTHING, st.sampled_from(["xyxy", "yxyx"]))
def test_whatever_stands_for_a_box_gives_four_finite_numbers_or_none(value, order):
    found = read_corners({"bbox": value}, order)
    assert found is None or (len(found) == 4 and all(math.isfinite(number) for number in found))


@given(st.lists(st.floats(-2000, 4000), min_size=4, max_size=4), st.tuples(st.integers(1, 4000), st.integers(1, 4000)))
def test_a_box_that_is_taken_lies_in_the_picture_and_is_no_line(numbers, sent):
    box, why = normalise_box(tuple(numbers), THOUSANDTHS, sent)
    if box is None:
        assert why
        return
    Detection(label="mug", bbox_xyxy=box)
    assert (box[2] - box[0]) * sent[0] / 1000 >= MIN_SIDE_PX
    assert (box[3] - box[1]) * sent[1] / 1000 >= MIN_SIDE_PX
    again, done = normalise_box(box, THOUSANDTHS, sent)
    assert (again, done) == (box, "")
    assert bool(why) == (box != tuple(numbers))


@given(BOXES)
def test_swapped_corners_are_put_right(box):
    x0, y0, x1, y1 = map(float, box)
    for turned in ((x1, y0, x0, y1), (x0, y1, x1, y0), (x1, y1, x0, y0)):
        assert normalise_box(turned, THOUSANDTHS, SENT) == ((x0, y0, x1, y1), "corners put in order")


@pytest.mark.parametrize(
    ("corners", "taken"),
    [
        ((-12.0, 5.0, 400.0, 1008.0), (0.0, 5.0, 400.0, 1000.0)),
        ((-SLACK - 1, 5.0, 400.0, 900.0), None),
        ((10.0, 5.0, 400.0, 1000.0 + SLACK + 1), None),
        ((1001.0, 5.0, 1020.0, 900.0), None),
        ((400.0, 5.0, 400.0, 900.0), None),
        ((400.0, 5.0, 401.0, 900.0), None),
    ],
)
def test_what_reaches_out_is_clipped_and_what_is_far_out_or_a_line_is_refused(corners, taken):
    assert normalise_box(corners, THOUSANDTHS, SENT)[0] == taken


@given(st.lists(BOXES, min_size=2, max_size=8))
def test_fractions_and_pixels_are_told_from_thousandths_where_that_is_sure(boxes):
    boxes = [(0, 300, 1000, 1000), (20, 500, 990, 1000), *boxes]
    fractions = [tuple(value / 1000 for value in box) for box in boxes]
    pixels = [tuple(value * side / 1000 for value, side in zip(box, SENT * 2, strict=True)) for box in boxes]
    for unit, written in (("thousandths", boxes), ("fractions", fractions), ("pixels", pixels)):
        scale = infer_scale(written, SENT)
        assert scale.unit == unit
        for box, own in zip(boxes, written, strict=True):
            found, _ = normalise_box(tuple(map(float, own)), scale, SENT)
            assert found == pytest.approx(box)


def test_one_wild_box_makes_no_pixels_and_boxes_in_no_unit_are_refused():
    sound = [(0, 300, 1000, 1000), (100, 400, 200, 500)]
    assert infer_scale([*sound, (900, 900, 1400, 1100)], SENT).unit == "thousandths"
    assert infer_scale([*sound, *sound, (900, 900, 1600, 1100), (900, 900, 1500, 1100)], SENT).unit == "thousandths"
    assert infer_scale([], SENT).unit == "thousandths"
    with pytest.raises(AnswerInvalidError, match="reach 3200: they must be normalised"):
        infer_scale([(0, 900, 3200, 2400), (400, 1200, 1500, 1900)], SENT)


def test_in_a_picture_of_less_than_a_thousand_pixels_they_cannot_be_told():
    assert infer_scale([(0, 100, 640, 480), (10, 200, 630, 470)], (640, 480)).unit == "thousandths"


@pytest.mark.heavy
@given(ANYTHING, ANYTHING, ANYTHING, ANYTHING)
def test_no_answer_breaks_the_reading_or_the_rules(label, box, people, count):
    table = {"label": "table", "bbox_xyxy": [0, 300, 1000, 1000]}
    entry = {"label": label, "bbox": box, "count": count, "score": count, "held": label, "description": label}
    filled = {"container": entry, "contents": [entry, box, entry], "description": box}
    composites = [filled, filled, people, {"container": {"label": "bowl", "bbox": [1, 2, 99, 99]}, "contents": box}]
    text = json.dumps({"detections": [table, entry, count], "composites": composites, "people": people})
    with suppress(AnswerInvalidError):
        found = apply_rules(parse_detections(text, "xyxy", SENT))[0]
        assert all(len(item.label) <= 120 for item in found.detections)
        assert Detections.model_validate_json(found.model_dump_json()) == found
