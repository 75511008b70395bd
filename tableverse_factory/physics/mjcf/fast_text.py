"""Tables of numbers as text, all digits at once: Python formats the thousands of lines of an OBJ file one by one."""

import numpy as np
from jaxtyping import Float64, Int64, UInt8

from tableverse_factory.core.errors import GeometryError

_ZERO, _MINUS, _POINT = b"0"[0], b"-"[0], b"."[0]
_NOTHING = 0
"""Stands where a shorter number has no digit; no text holds it."""

_FEW = 600
"""So few numbers Python formats sooner."""

_EXACT = 2.0**53
"""From here on a float64 does not hold every whole number."""


def lines_of_integers(head: bytes, numbers: Int64[np.ndarray, "n k"], ends: bytes) -> bytes:
    """A line per row: `head`, then each number with the character that follows it.

    Args:
        head: Start of every line.
        numbers: Not negative for the quick way; Python formats negative ones, and those too large for a table.
        ends: What follows the number of each column. Length k.
    """
    if numbers.size < _FEW or numbers.min() < 0 or numbers.max() > 10 * numbers.size:
        return _formatted(head, numbers, "%d", ends)
    known = np.arange(int(numbers.max(initial=0)) + 1)
    digits = _without_leading_zeros(_digits(known, len(str(len(known)))), 1)
    return _lines(head, digits[numbers], ends)


def lines_of_decimals(head: bytes, numbers: Float64[np.ndarray, "n k"], decimals: int, ends: bytes) -> bytes:
    """The same with numbers of so many decimals, all of them shown; others are rounded, and zero has no sign.

    Raises:
        GeometryError: if a number is not finite: no file of ours says so.
    """
    if not np.isfinite(numbers).all():
        raise GeometryError("a table of numbers to be written holds NaN or infinite ones")
    if numbers.size < _FEW or float(np.abs(numbers).max()) >= _EXACT / 10.0**decimals:
        zero = f"{0.0:.{decimals}f}".encode()
        return _formatted(head, numbers, f"%.{decimals}f", ends).replace(b"-" + zero, zero)
    units = np.rint(np.abs(numbers) * 10.0**decimals).astype(np.int64)
    whole = max(1, len(str(int(units.max(initial=0)))) - decimals)
    digits = _without_leading_zeros(_digits(units, whole + decimals), decimals + 1)
    sign = np.where((numbers < 0.0) & (units > 0), _MINUS, _NOTHING).astype(np.uint8)[..., None]
    point = np.full_like(sign, _POINT)
    return _lines(head, np.concatenate([sign, digits[..., :whole], point, digits[..., whole:]], axis=-1), ends)


def _formatted(head: bytes, numbers: np.ndarray, form: str, ends: bytes) -> bytes:
    """As Python writes them, one by one."""
    line = head.decode() + "".join(form + end for end in ends.decode())
    return ((line * len(numbers)) % tuple(numbers.ravel().tolist())).encode()


def _digits(numbers: Int64[np.ndarray, "*n"], count: int) -> UInt8[np.ndarray, "*n c"]:
    """The last `count` decimal digits of each number, as characters."""
    digits = np.empty((*numbers.shape, count), dtype=np.uint8)
    left = numbers
    for place in range(count - 1, -1, -1):
        shorter = left // 10
        digits[..., place] = left - 10 * shorter + _ZERO
        left = shorter
    return digits


def _without_leading_zeros(digits: UInt8[np.ndarray, "*n c"], least: int) -> UInt8[np.ndarray, "*n c"]:
    """`_NOTHING` in place of leading zeros, but for the last `least` digits."""
    leading = np.logical_and.accumulate(digits == _ZERO, axis=-1)
    leading[..., digits.shape[-1] - least :] = False
    return np.where(leading, np.uint8(_NOTHING), digits)


def _lines(head: bytes, fields: UInt8[np.ndarray, "n k c"], ends: bytes) -> bytes:
    count, columns, width = fields.shape
    text = np.empty((count, len(head) + columns * (width + 1)), dtype=np.uint8)
    text[:, : len(head)] = np.frombuffer(head, dtype=np.uint8)
    cells = text[:, len(head) :].reshape(count, columns, width + 1)  # a view: `text` is filled
    cells[..., :width], cells[..., width] = fields, np.frombuffer(ends, dtype=np.uint8)
    return bytes(text[text != _NOTHING])
