"""Numbers as text, all at once: the same text that Python's formatting gives, number by number."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tableverse_factory.core.errors import GeometryError
from tableverse_factory.physics.mjcf.number_format import format_decimal_lines, format_integer_lines

REPEATS = 300
"""Tables so long that they are not left to Python."""


@given(st.lists(st.integers(0, 10**6), min_size=3, max_size=3))
def test_integers_are_written_as_python_writes_them(row: list[int]) -> None:
    table = np.array([row, [0, 9, 10]] * REPEATS, dtype=np.int64)
    expected = "".join(f"f {a}/{b} {c}\n" for a, b, c in table.tolist())
    assert format_integer_lines(b"f ", table, b"/ \n").decode() == expected


@given(st.lists(st.integers(-(10**11), 10**11), min_size=2, max_size=2), st.integers(1, 11))
def test_decimals_are_written_as_python_writes_them(units: list[int], decimals: int) -> None:
    numbers = np.array([[unit / 10**decimals for unit in units], [0.0, 1.0]] * REPEATS)
    expected = "".join(f"v {a:.{decimals}f} {b:.{decimals}f}\n" for a, b in numbers.tolist())
    assert format_decimal_lines(b"v ", numbers, decimals, b" \n").decode() == expected


@pytest.mark.parametrize("count", [1, 2 * REPEATS])
def test_long_and_short_tables_are_written_alike(count: int) -> None:
    line = format_decimal_lines(b"v ", np.array([[-0.0000001, 40.0, 0.25]] * count), 7, b"  \n")
    assert line == b"v -0.0000001 40.0000000 0.2500000\n" * count


@pytest.mark.parametrize("count", [1, 2 * REPEATS])
@pytest.mark.parametrize(
    ("number", "text"),
    [
        (-1e-9, "0.000000"),
        (-0.0, "0.000000"),
        (-4e-7, "0.000000"),
        (-6e-7, "-0.000001"),
        (-10.0, "-10.000000"),
        (2.0**53 / 1e6, f"{2.0**53 / 1e6:.6f}"),
        (1e13, "10000000000000.000000"),
        (-1e300, f"{-1e300:.6f}"),
    ],
)
def test_tiny_and_huge_numbers_are_written_alike_in_long_and_short_tables(count: int, number: float, text: str) -> None:
    line = format_decimal_lines(b"v ", np.array([[number, 1.0]] * count), 6, b" \n")
    assert line.decode() == f"v {text} 1.000000\n" * count


@pytest.mark.parametrize("count", [1, 2 * REPEATS])
@pytest.mark.parametrize("number", [np.nan, np.inf, -np.inf])
def test_what_is_no_number_is_not_written(count: int, number: float) -> None:
    with pytest.raises(GeometryError, match="NaN or infinite"):
        format_decimal_lines(b"v ", np.array([[number, 1.0]] * count), 6, b" \n")


@pytest.mark.parametrize("count", [1, 2 * REPEATS])
def test_any_integers_are_written(count: int) -> None:
    line = format_integer_lines(b"f ", np.array([[-3, 10**15]] * count), b"/\n")
    assert line == b"f -3/1000000000000000\n" * count


def test_an_empty_table_is_no_text() -> None:
    assert format_integer_lines(b"f ", np.zeros((0, 3), dtype=np.int64), b"  \n") == b""
