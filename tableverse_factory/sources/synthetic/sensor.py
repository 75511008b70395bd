"""Model of a structured-light camera: noise that grows with z², quantization, shadows, holes; grain in colour.

The depth error follows the usual model of triangulating sensors (Khoshelham and Elberink, 2012): a constant error of
the disparity in pixels, so an error of depth that grows with its square.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64, UInt16
from scipy.ndimage import binary_dilation, gaussian_filter, maximum_filter, minimum_filter

from schemas.geometry import Camera, DepthImage, Picture

Plane = Float64[np.ndarray, "h w"]

FARTHEST_M = 4.0


@dataclass(frozen=True, slots=True)
class DepthSensor:
    """Parameters of a structured-light camera.

    Attributes:
        baseline_m: From the camera to the projector, which stands to its left.
        disparity_sigma: Error of the disparity [px]; half of it is shared by neighbouring pixels.
        disparity_step: Smallest difference of disparity that is told apart [px].
        wobble: Displacement of readings at depth edges [px].
        dropout: Share of pixels without a reading for no reason.
        depth_scale: Metres per unit of the depth image.
    """

    baseline_m: float = 0.075
    disparity_sigma: float = 0.05
    disparity_step: float = 1 / 16
    wobble: float = 0.5
    dropout: float = 0.004
    depth_scale: float = 0.001

    def sigma_m(self, depth_m: float, focal_px: float) -> float:
        """Compute the standard deviation of the depth at a distance, quantization included [m]."""
        per_pixel = depth_m**2 / (focal_px * self.baseline_m)
        steps = np.hypot(self.disparity_step * per_pixel, self.depth_scale) / np.sqrt(12.0)
        return float(np.hypot(self.disparity_sigma * per_pixel, steps))


def make_sensor(rng: np.random.Generator) -> DepthSensor:
    """Draw a sensor within the spread of common ones."""
    return DepthSensor(
        baseline_m=float(rng.uniform(0.065, 0.085)),
        disparity_sigma=float(rng.uniform(0.025, 0.065)),
        wobble=float(rng.uniform(0.3, 0.7)),
        dropout=float(rng.uniform(0.001, 0.008)),
        depth_scale=float(rng.choice([0.001, 0.0001])),
    )


def sense_depth(
    rng: np.random.Generator, sensor: DepthSensor, camera: Camera, truth: DepthImage, facing: Plane, shiny: Plane
) -> UInt16[np.ndarray, "h w"]:
    """Simulate the depth image of a sensor, 0 where it has no reading, from the true depth [m], 0 for none.

    `facing` is the cosine between normal and line of sight; `shiny` is 0 for matt to 1 for polished.
    """
    readable = (truth > 0.0) & (truth < FARTHEST_M)
    moved = (
        np.rint(i + _make_correlated_noise(rng, truth.shape, 1.2) * sensor.wobble) for i in np.indices(truth.shape)
    )
    rows, columns = (np.clip(m.astype(np.intp), 0, size - 1) for m, size in zip(moved, truth.shape, strict=True))
    depth = np.where(readable, truth, FARTHEST_M).astype(np.float64)[rows, columns]
    readable &= readable[rows, columns]
    per_metre = camera.fx * sensor.baseline_m
    error = np.sqrt(0.5) * (rng.standard_normal(truth.shape) + _make_correlated_noise(rng, truth.shape, 1.5))
    disparity = per_metre / depth + sensor.disparity_sigma * error
    disparity = np.maximum(np.rint(disparity / sensor.disparity_step) * sensor.disparity_step, sensor.disparity_step)
    readable &= ~_find_shadows(per_metre / depth)
    readable &= ~_find_holes(rng, sensor, depth, facing, shiny)
    units = np.rint(per_metre / disparity / sensor.depth_scale)
    return np.where(readable & (units <= 65535), units, 0).astype(np.uint16)


def sense_color(rng: np.random.Generator, picture: Picture) -> Picture:
    """Simulate a colour camera: white balance a little off, darker corners, grain."""
    height, width = picture.shape[:2]
    y, x = np.mgrid[-1 : 1 : height * 1j, -1 : 1 : width * 1j]
    gains = 1.0 + rng.normal(0.0, 0.02, 3)
    vignette = 1.0 - rng.uniform(0.0, 0.09) * (x * x + y * y)
    grain = rng.standard_normal(picture.shape, dtype=np.float32) * rng.uniform(1.0, 2.6)
    return np.clip(np.rint(picture * gains * vignette[..., None] + grain), 0, 255).astype(np.uint8)


def _find_shadows(disparity: Plane) -> np.ndarray:
    """Find pixels that a nearer surface hides from the projector.

    Seen from the projector, to the left, a point at column u stands at column u + disparity: in the camera's order
    from left to right these columns grow, except where a nearer surface has been passed.
    """
    columns = np.arange(disparity.shape[1]) + disparity
    return columns < np.maximum.accumulate(columns, axis=1) - 0.75


def _find_holes(rng: np.random.Generator, sensor: DepthSensor, depth: Plane, facing: Plane, shiny: Plane) -> np.ndarray:
    """Find pixels without a reading: grazing surfaces, depth edges, polished metal, and random dropout."""
    shape = depth.shape
    grazing = rng.random(shape) > 1.0 / (1.0 + np.exp(-(facing - 0.16) / 0.035))
    edge = maximum_filter(depth, 3) - minimum_filter(depth, 3) > 0.02 * depth
    edge &= rng.random(shape) < 0.55
    # Patches of a shiny surface mirror the projector away; their size is that of the correlation window.
    glare = _make_correlated_noise(rng, shape, 5.0) > 2.6 - 2.1 * shiny
    blots = binary_dilation(rng.random(shape) < sensor.dropout / 40.0, iterations=3)
    return grazing | edge | (glare & (shiny > 0.05)) | blots | (rng.random(shape) < sensor.dropout / 2)


def _make_correlated_noise(rng: np.random.Generator, shape: tuple[int, ...], radius: float) -> Plane:
    """Make noise of unit variance, correlated over `radius` pixels."""
    smooth = gaussian_filter(rng.standard_normal(shape), radius, mode="wrap")
    return smooth / smooth.std()
