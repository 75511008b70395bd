"""A sheet of paper tells the focal length, and says how surely; what is no sheet, or tells nothing, tells none."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from schemas.known_length import SHEET_SIZES_M
from tableverse_factory.stages.observe.depth.sheet_focal import Focal, estimate_sheet_focal

SIZE = (640, 480)
USUAL = Focal(577.0, 0.2, "assumed")


def see_sheet(sides_m, focal_px, pitch_deg, heading_deg=20.0, noise_px=0.0, seed=0, distance_m=0.7):
    """Pixels of the corners of a sheet that lies on a table, `pitch_deg` below the line of sight."""
    rng = np.random.default_rng(seed)
    sheet = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) / 2 * [*sides_m, 0.0]
    turned = Rotation.from_euler("zx", [heading_deg, 90.0 + pitch_deg], degrees=True).apply(sheet)
    points = turned + np.array([0.03, 0.02, distance_m])
    pixels = focal_px * points[:, :2] / points[:, 2:] + (np.array(SIZE) - 1) / 2
    return (pixels + rng.normal(0.0, noise_px, (4, 2))).tolist() if noise_px else pixels.tolist()


@pytest.mark.parametrize("kind", ["a4", "us_letter"])
@pytest.mark.parametrize("focal_px", [450.0, 577.0, 750.0])
@pytest.mark.parametrize("first", range(4))
@pytest.mark.parametrize("way", [1, -1])
def test_exact_corners_tell_the_focal_length_wherever_they_begin(kind, focal_px, first, way):
    pixels = see_sheet(SHEET_SIZES_M[kind], focal_px, 45.0)
    found = estimate_sheet_focal(np.roll(pixels, first, axis=0)[::way].tolist(), SHEET_SIZES_M[kind], SIZE, USUAL)
    assert found is not None
    assert found.px == pytest.approx(focal_px, rel=0.03)  # drawn towards the usual one


def test_it_is_as_sure_as_it_says():
    rng = np.random.default_rng(3)
    off = []
    for seed in range(60):
        focal_px, pitch_deg = USUAL.px * np.exp(rng.normal(0.0, 0.2)), rng.uniform(30.0, 65.0)
        pixels = see_sheet(SHEET_SIZES_M["a4"], focal_px, pitch_deg, rng.uniform(0.0, 360.0), 0.64, seed)
        if (found := estimate_sheet_focal(pixels, SHEET_SIZES_M["a4"], SIZE, USUAL)) is not None:
            off.append(np.log(found.px / focal_px) / found.sigma)
    assert len(off) > 50
    assert 0.55 < np.mean(np.abs(off) < 1.0) < 0.95
    assert np.abs(off).max() < 4.5


@pytest.mark.parametrize(
    ("kind", "pitch_deg"), [("a4", 90.0), ("bank_card", 30.0)], ids=["from straight above", "too small"]
)
def test_a_sheet_that_tells_nothing_tells_none(kind, pitch_deg):
    pixels = see_sheet(SHEET_SIZES_M[kind], 577.0, pitch_deg)
    assert estimate_sheet_focal(pixels, SHEET_SIZES_M[kind], SIZE, USUAL) is None


@pytest.mark.parametrize(
    "pixels",
    [
        pytest.param([(100, 100), (130, 100), (130, 400), (100, 400)], id="a strip"),
        pytest.param([(0, 0), (639, 0), (639, 4), (0, 479)], id="a sliver"),
        pytest.param([(300, 10), (320, 470), (322, 470), (340, 10)], id="a spike"),
    ],
)
def test_corners_of_something_else_tell_none(pixels):
    assert estimate_sheet_focal(pixels, SHEET_SIZES_M["a4"], SIZE, USUAL) is None


@pytest.mark.parametrize("shift_px", [(-64.0, 0.0), (15.0, -10.0)], ids=["cut at the left", "a lens off its middle"])
def test_a_picture_whose_middle_is_not_the_lens_says_how_sure_it_is(shift_px):
    rng = np.random.default_rng(4)
    off = []
    for seed in range(40):
        focal_px, pitch_deg = USUAL.px * np.exp(rng.normal(0.0, 0.2)), rng.uniform(30.0, 65.0)
        pixels = np.array(see_sheet(SHEET_SIZES_M["a4"], focal_px, pitch_deg, rng.uniform(0.0, 360.0), 0.64, seed))
        if (found := estimate_sheet_focal(pixels + shift_px, SHEET_SIZES_M["a4"], SIZE, USUAL)) is not None:
            off.append(np.log(found.px / focal_px) / found.sigma)
    assert len(off) > 15
    assert np.mean(np.abs(off) < 1.0) > 0.55
