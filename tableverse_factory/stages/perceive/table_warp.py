"""Warp of the flat table by a sensor or a depth model."""

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Mask

MIN_PIXELS = 500
SAMPLES = 9000


def fit_warp(
    xy: Float64[np.ndarray, "h w 2"], heights: Float64[np.ndarray, "h w"], flat: Mask, most: float, degree: int
) -> Float64[np.ndarray, "h w"]:
    """Fit a polynomial in coordinates along the table to the heights of the flat pixels, without objects on them [m].

    The result is at most `most` [m] either way: polynomials run away beyond their support.
    """
    if int(flat.sum()) < MIN_PIXELS:
        return np.zeros(heights.shape)
    step = max(1, int(flat.sum()) // SAMPLES)
    sample, h = xy[flat][::step], heights[flat][::step]
    center, size = sample.mean(axis=0), sample.std(axis=0) + 1e-6
    terms = _build_monomials((sample - center) / size, degree)
    keep = np.ones(len(h), dtype=bool)
    for _ in range(4):
        weights = np.linalg.lstsq(terms[keep], h[keep], rcond=None)[0]
        keep = np.abs(terms @ weights - h) <= np.maximum(2.0 * np.std(h[keep] - terms[keep] @ weights), 0.002)
    return np.clip(_evaluate_polynomial((xy - center) / size, weights, degree), -most, most)


def _evaluate_polynomial(
    xy: Float64[np.ndarray, "*shape 2"], weights: Float64[np.ndarray, " k"], degree: int
) -> Float64[np.ndarray, "*shape"]:
    """Evaluate `_build_monomials(xy, degree) @ weights` by Horner's rule, without an array for each term."""
    x, y = np.ascontiguousarray(xy[..., 0]), np.ascontiguousarray(xy[..., 1])
    of_term = dict(zip(_list_powers(degree), weights.tolist(), strict=True))
    result: Float64[np.ndarray, "*shape"] = np.zeros(x.shape)
    for power in range(degree, -1, -1):  # of y; its factor is a polynomial in x
        factor = np.full(x.shape, of_term[degree - power, power])
        for lower in range(degree - power - 1, -1, -1):
            factor *= x
            factor += of_term[lower, power]
        result *= y
        result += factor
    return result


def _build_monomials(xy: Float64[np.ndarray, "*shape 2"], degree: int) -> Float64[np.ndarray, "*shape k"]:
    x, y = xy[..., 0], xy[..., 1]
    return np.stack([x**i * y**j for i, j in _list_powers(degree)], axis=-1)


def _list_powers(degree: int) -> list[tuple[int, int]]:
    return [(total - k, k) for total in range(degree + 1) for k in range(total + 1)]
