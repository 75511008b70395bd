"""What an error is called in the dataset: one bounded line, the same on every machine."""

import sys
import tempfile

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.outcome import MAX_DETAIL_CHARS, Dropped, Failed
from tableverse_factory.core.errors import GeometryError, InputError
from tests.helpers.paths import ROOT
from workers.sandbox.error_text import bound_drop, bound_failure, make_failure, sanitize_error_text


@settings(max_examples=30)  # long texts take their time to be drawn
@given(st.text(max_size=3 * MAX_DETAIL_CHARS))
def test_any_text_becomes_one_bounded_printable_line(text):
    line = sanitize_error_text(text)
    assert len(line) <= MAX_DETAIL_CHARS
    assert line.isprintable()
    assert line == line.strip()
    assert sanitize_error_text(line) == line


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (f"{ROOT}/tableverse_factory/settle.py broke", "tableverse_factory/settle.py broke"),
        (f"{sys.prefix}/lib/x.so", "lib/x.so"),
        ("<object at 0x7f12ab34cd56>", "<object at 0x…>"),
        (f"{tempfile.gettempdir()}/tmpab12_z9k/mesh.obj", "<temporary>/mesh.obj"),  # noqa: S108
        ("/home/me/captures/7 is no capture", "/home/me/captures/7 is no capture"),
        ("mask 0x1f", "mask 0x1f"),
    ],
)
def test_what_differs_between_machines_goes_and_the_users_own_values_stay(text, line):
    assert sanitize_error_text(text) == line


def test_our_own_errors_keep_their_class_and_strange_ones_their_place():
    assert make_failure(InputError("no depth")) == Failed("InputError", "no depth")
    assert make_failure(GeometryError("open")) == Failed("GeometryError", "open")
    assert make_failure(MemoryError("12 GB")).error_kind == "out_of_memory"
    try:
        sanitize_error_text(None)
    except TypeError as error:
        failure = make_failure(error)
    assert failure.error_kind == "exception"
    assert failure.message.startswith("TypeError: ")
    assert "workers/sandbox/error_text.py:" in failure.message


def test_codes_are_bounded():
    assert len(bound_drop(Dropped("r" * 500, "d" * 9000)).reason) == 80
    assert len(bound_failure(Failed("k" * 500, "m")).error_kind) == 80
