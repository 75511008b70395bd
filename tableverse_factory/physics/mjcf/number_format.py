"""Fast, vectorised formatting of number tables, for OBJ files of thousands of lines."""

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from tableverse_factory.core.errors import GeometryError

_ZERO, _MINUS, _POINT = b"0"[0], b"-"[0], b"."[0]
_BLANK = 0  # placeholder where a shorter number has no digit; it is removed at the end
_MIN_VECTORIZED = 600  # Python formats fewer numbers faster
_MAX_EXACT_INTEGER = 2.0**53  # limit of exact integers in float64


def format_integer_lines(head: bytes, numbers: Int64[np.ndarray, "n k"], ends: bytes) -> bytes:
    """Format a line per row: `head`, then each number with the character of `ends` that follows its column.

    Negative numbers, and those too large for a table of digits, are formatted by Python.
    """
    if numbers.size < _MIN_VECTORIZED or numbers.min() < 0 or numbers.max() > 10 * numbers.size:
        return _format_each(head, numbers, "%d", ends)
    known = np.arange(int(numbers.max(initial=0)) + 1)
    digits = _blank_leading_zeros(_split_digits(known, len(str(len(known)))), 1)
    return _join_fields(head, digits[numbers], ends)


def format_decimal_lines(head: bytes, numbers: Float64[np.ndarray, "n k"], decimals: int, ends: bytes) -> bytes:
    """Format like `format_integer_lines` with a fixed number of decimals, rounded; zero has no sign."""
    if not np.isfinite(numbers).all():
        raise GeometryError("a table of numbers to be written holds NaN or infinite ones")
    if numbers.size < _MIN_VECTORIZED or float(np.abs(numbers).max()) >= _MAX_EXACT_INTEGER / 10.0**decimals:
        zero = f"{0.0:.{decimals}f}".encode()
        return _format_each(head, numbers, f"%.{decimals}f", ends).replace(b"-" + zero, zero)
    units = np.rint(np.abs(numbers) * 10.0**decimals).astype(np.int64)
    whole = max(1, len(str(int(units.max(initial=0)))) - decimals)
    digits = _blank_leading_zeros(_split_digits(units, whole + decimals), decimals + 1)
    sign = np.where((numbers < 0.0) & (units > 0), _MINUS, _BLANK).astype(np.uint8)[..., None]
    point = np.full_like(sign, _POINT)
    return _join_fields(head, np.concatenate([sign, digits[..., :whole], point, digits[..., whole:]], axis=-1), ends)


def _format_each(head: bytes, numbers: np.ndarray, form: str, ends: bytes) -> bytes:
    line = head.decode() + "".join(form + end for end in ends.decode())
    return ((line * len(numbers)) % tuple(numbers.ravel().tolist())).encode()


def _split_digits(numbers: Int64[np.ndarray, "*n"], count: int) -> UInt8[np.ndarray, "*n c"]:
    """The last `count` decimal digits of each number, as characters."""
    digits = np.empty((*numbers.shape, count), dtype=np.uint8)
    left = numbers
    for place in range(count - 1, -1, -1):
        shorter = left // 10
        digits[..., place] = left - 10 * shorter + _ZERO
        left = shorter
    return digits


def _blank_leading_zeros(digits: UInt8[np.ndarray, "*n c"], least: int) -> UInt8[np.ndarray, "*n c"]:
    """Put `_BLANK` in place of leading zeros, but for the last `least` digits."""
    leading = np.logical_and.accumulate(digits == _ZERO, axis=-1)
    leading[..., digits.shape[-1] - least :] = False
    return np.where(leading, np.uint8(_BLANK), digits)


def _join_fields(head: bytes, fields: UInt8[np.ndarray, "n k c"], ends: bytes) -> bytes:
    count, columns, width = fields.shape
    text = np.empty((count, len(head) + columns * (width + 1)), dtype=np.uint8)
    text[:, : len(head)] = np.frombuffer(head, dtype=np.uint8)
    cells = text[:, len(head) :].reshape(count, columns, width + 1)  # a view: `text` is filled
    cells[..., :width], cells[..., width] = fields, np.frombuffer(ends, dtype=np.uint8)
    return bytes(text[text != _BLANK])
