"""Feature statistics for normalization in LeRobot's format, per episode and aggregated."""

from collections.abc import Mapping, Sequence

import numpy as np

FeatureStats = dict[str, np.ndarray]  # `min`, `max`, `mean`, `std` and quantiles of each component, and `count`
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_MAX_PICTURES = 100  # pictures used per episode, spread over it; every second pixel of every second row of each


def compute_vector_stats(values: np.ndarray) -> FeatureStats:
    """Compute statistics of values over time, shape (t,) or (t, n), each of shape (1,) or (n,); `count` is t."""
    return _compute_stats(values.reshape(len(values), -1).astype(np.float64), len(values))


def compute_picture_stats(pictures: Sequence[np.ndarray]) -> FeatureStats:
    """Compute statistics of pictures, each of shape (c, 1, 1); `count` is the pictures used.

    Those of bytes are shares of 255, as LeRobot has colours; depth stays in meters.
    """
    chosen = np.unique(np.rint(np.linspace(0, len(pictures) - 1, min(len(pictures), _MAX_PICTURES))).astype(int))
    channels, full = pictures[0].shape[2], 255.0 if pictures[0].dtype == np.uint8 else 1.0
    pixels = np.concatenate([pictures[k][::2, ::2].reshape(-1, channels) for k in chosen])
    figures = _compute_stats(pixels.astype(np.float64) / full, len(chosen))
    return {name: value if name == "count" else value.reshape(channels, 1, 1) for name, value in figures.items()}


def _compute_stats(values: np.ndarray, count: int) -> FeatureStats:
    quantiles = np.quantile(values, list(QUANTILES.values()), axis=0)
    return {
        "min": values.min(axis=0),
        "max": values.max(axis=0),
        "mean": values.mean(axis=0),
        "std": values.std(axis=0),
        "count": np.array([count], dtype=np.int64),
        **dict(zip(QUANTILES, quantiles, strict=True)),
    }


def merge_stats(all_figures: Sequence[Mapping[str, np.ndarray]]) -> FeatureStats:
    """Merge statistics of episodes: exact except for the quantiles, which are means weighted by `count`."""
    counts = np.array([figures["count"][0] for figures in all_figures], dtype=np.float64)
    weights = counts / counts.sum()

    def weighted(name: str) -> np.ndarray:
        return np.tensordot(weights, np.stack([figures[name] for figures in all_figures]), axes=1)

    mean = weighted("mean")
    variances = [figures["std"] ** 2 + (figures["mean"] - mean) ** 2 for figures in all_figures]
    return {
        "min": np.min([figures["min"] for figures in all_figures], axis=0),
        "max": np.max([figures["max"] for figures in all_figures], axis=0),
        "mean": mean,
        "std": np.sqrt(np.tensordot(weights, np.stack(variances), axes=1)),
        "count": np.array([int(counts.sum())], dtype=np.int64),
        **{name: weighted(name) for name in QUANTILES},
    }
