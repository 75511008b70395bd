"""The picture on the exported table stands for the colour that was seen."""

import io

import numpy as np
import pytest
from PIL import Image

from tableverse_factory.stages.export.tabletop import MAX_SHARE, MAX_SPREAD, SIDE_PX, draw_tabletop_texture

COLORS = [(0, 0, 0), (88, 40, 24), (150, 30, 30), (20, 60, 140), (128, 128, 128), (200, 180, 140), (245, 245, 245)]


@pytest.mark.parametrize("color", COLORS)
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_it_has_the_colour_and_no_bold_pattern(color, seed):
    png = draw_tabletop_texture(np.random.default_rng(seed), color)
    picture = np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), dtype=np.float64)
    assert picture.shape == (SIDE_PX, SIDE_PX, 3)
    wanted = np.array(color, dtype=np.float64)
    assert np.abs(picture.mean(axis=(0, 1)) - wanted).max() <= 2.0
    assert (picture.std(axis=(0, 1)) <= np.minimum(MAX_SPREAD, MAX_SHARE * np.maximum(wanted, 1.0)) + 1.5).all()
    assert len(png) < 100_000
