"""A known length: canonical text that comes back, and one line of what is wrong with anything else."""

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from schemas.known_length import MAX_CHARS, encode_known_length, parse_known_length
from schemas.manifest import ImageRow, SceneKind

SQUARE = [[0, 0], [100, 0], [100, 140], [0, 140]]
GOOD = {
    "distance": {"kind": "distance", "length_m": 0.3, "pixels": [[1, 2.5], [30, 40]]},
    "a4": {"kind": "a4", "pixels": SQUARE},
    "us_letter": {"kind": "us_letter", "pixels": SQUARE[::-1]},
    "bank_card": {"kind": "bank_card", "pixels": SQUARE},
    "height by a pixel": {"kind": "height", "length_m": 0.1, "pixels": [[5, 6]]},
    "height by a label": {"kind": "height", "length_m": 0.1, "label": "mug"},
    "camera_height": {"kind": "camera_height", "length_m": 0.6},
}
NUMBERS = st.floats() | st.integers() | st.booleans() | st.none() | st.text(max_size=5)
HOSTILE = st.dictionaries(
    st.sampled_from(["kind", "length_m", "pixels", "label", "other"]),
    NUMBERS
    | st.sampled_from(["distance", "a4", "height", "camera_height"])
    | st.lists(st.lists(NUMBERS, max_size=3), max_size=5),
)


@pytest.mark.parametrize("name", GOOD)
def test_a_known_length_comes_back_from_its_text(name):
    known = parse_known_length(json.dumps(GOOD[name]))
    text = encode_known_length(known)
    assert parse_known_length(text) == known
    assert json.loads(text) == GOOD[name], "nothing but what was given"
    assert len(text) <= MAX_CHARS
    row = ImageRow(scene_id="a", kind=SceneKind.IMAGE, uri="/x", known_length=json.dumps(GOOD[name], indent=3))
    assert row.known_length == text, "one spelling, so that equal lengths give equal ids"


@pytest.mark.parametrize(
    ("kind", "change", "told"),
    [
        ("distance", {"length_m": 1e9}, "length_m: give at most 10, not 1000000000.0"),
        ("distance", {"length_m": -0.3}, "length_m: give at least 0.01, not -0.3"),
        ("distance", {"length_m": "0.3"}, "length_m: give a number, not '0.3'"),
        ("distance", {"length_m": True}, "length_m: give a number, not True"),
        ("distance", {"length_m": float("nan")}, "finite number, not nan"),
        ("distance", {"length_m": 10**400}, "finite number"),
        ("distance", {"pixels": [[1, 2]]}, "pixels.1: is missing"),
        ("distance", {"pixels": [[1, 2], [3, 2]]}, "less than 4 px apart"),
        ("distance", {"pixels": [[1, 2], [3e9, 2]]}, "pixels.1.0: give at most 100000, not 3000000000.0"),
        (
            "distance",
            {"kind": "inches"},
            "'us_letter', 'bank_card', 'height', 'camera_height', not 'inches'",
        ),
        ("distance", {"kind": None}, "kind"),
        ("distance", {"unit": "cm"}, "unit: is no key here: leave it out"),
        ("a4", {"pixels": [SQUARE[0], SQUARE[2], SQUARE[1], SQUARE[3]]}, "go around it once"),
        ("a4", {"pixels": [[0, 0], [50, 0], [100, 0], [0, 140]]}, "go around it once"),
        ("a4", {"pixels": [SQUARE[0]] * 4}, "less than 4 px apart"),
        ("a4", {"length_m": 0.3}, "length_m: is no key here"),
        ("height by a pixel", {"label": "mug"}, "one of both"),
        ("height by a label", {"label": ""}, "one of both"),
        ("camera_height", {"length_m": 0.0}, "give at least 0.05, not 0.0"),
        ("camera_height", {"pixels": [[1, 2]]}, "pixels: give at most 0"),
    ],
)
def test_what_cannot_be_is_refused_by_name_and_value(kind, change, told):
    text = json.dumps(GOOD[kind] | change)
    with pytest.raises(ValueError, match=r".") as refused:
        parse_known_length(text)
    assert told in str(refused.value)
    assert "\n" not in str(refused.value)
    with pytest.raises(ValidationError):
        ImageRow(scene_id="a", kind=SceneKind.IMAGE, uri="/x", known_length=text)


@pytest.mark.parametrize("text", ["", "null", "7", "[]", "{", "[" * 900, "{}" * 900, '"a4"', "\x00"])
def test_what_is_no_object_is_refused(text):
    with pytest.raises(ValueError, match=r"[a-z]"):
        parse_known_length(text)


@given(HOSTILE)
def test_any_object_is_a_known_length_or_a_value_error(value):
    try:
        known = parse_known_length(json.dumps(value))
    except ValueError:
        return
    assert parse_known_length(encode_known_length(known)) == known
