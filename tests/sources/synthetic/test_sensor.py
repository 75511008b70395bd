import numpy as np
import pytest

from schemas.geometry import Camera
from tableverse_factory.sources.synthetic.sensor import DepthSensor, make_sensor, sense_color, sense_depth

CAMERA = Camera(600.0, 600.0, 159.5, 119.5, 320, 240)
SHAPE = (240, 320)
CALM = DepthSensor(wobble=0.0, dropout=0.0, depth_scale=0.0001)


def sense(truth: np.ndarray, sensor: DepthSensor = CALM, facing: float = 1.0, shiny: float = 0.0) -> np.ndarray:
    rng = np.random.default_rng(5)
    units = sense_depth(rng, sensor, CAMERA, truth, np.full(SHAPE, facing), np.full(SHAPE, shiny))
    return units * sensor.depth_scale


@pytest.mark.parametrize("distance", [0.6, 1.0, 1.3])
def test_noise_is_unbiased_and_as_large_as_it_says(distance: float) -> None:
    error = sense(np.full(SHAPE, distance, dtype=np.float32)) - distance
    sigma = CALM.sigma_m(distance, CAMERA.fx)
    assert abs(error.mean()) < 0.2 * sigma
    assert 0.7 * sigma < error.std() < 1.4 * sigma


def test_noise_grows_with_the_square_of_the_distance() -> None:
    assert CALM.sigma_m(1.2, 600.0) == pytest.approx(4 * CALM.sigma_m(0.6, 600.0), rel=0.05)


def test_what_the_projector_does_not_reach_has_no_reading() -> None:
    truth = np.full(SHAPE, 1.2, dtype=np.float32)
    truth[60:180, 100:200] = 0.8
    depth = sense(truth)
    # f b (1/z_near - 1/z_far) pixels to the right of the near thing lie in its shadow, none to its left.
    width = CAMERA.fx * CALM.baseline_m * (1 / 0.8 - 1 / 1.2)
    assert not depth[70:170, 201 : 200 + int(width) - 2].any()
    assert (depth[70:170, 200 + int(width) + 4 : 260] > 0).all()
    assert (depth[70:170, 60:98] > 0).all()


def test_no_reading_where_nothing_is_far_away_grazing_or_polished() -> None:
    assert not sense(np.zeros(SHAPE, dtype=np.float32)).any()
    assert not sense(np.full(SHAPE, 4.5, dtype=np.float32)).any()
    flat = np.full(SHAPE, 1.0, dtype=np.float32)
    assert (sense(flat, facing=0.03) == 0).mean() > 0.9
    assert (sense(flat, facing=0.5) == 0).mean() < 0.01
    assert 0.02 < (sense(flat, shiny=0.7) == 0).mean() < 0.6


def test_every_specimen_is_plausible() -> None:
    for seed in range(50):
        sensor = make_sensor(np.random.default_rng(seed))
        assert 0.0003 < sensor.sigma_m(1.0, 600.0) < 0.003
        assert sensor.depth_scale in (0.001, 0.0001)


def test_colour_keeps_its_shape_and_brightness() -> None:
    picture = np.full((*SHAPE, 3), 128, dtype=np.uint8)
    sensed = sense_color(np.random.default_rng(0), picture)
    assert sensed.dtype == np.uint8
    assert 110 < sensed.mean() < 140
    assert 0.5 < sensed.astype(float).std(axis=(0, 1)).max() < 12
