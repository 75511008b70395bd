"""A bare picture with a table gets depth and a camera; one without a table is dropped and says why."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import skimage
from PIL import Image

from schemas.config import Config, ObserveConfig
from schemas.geometry import Camera
from schemas.manifest import ImageRow, SceneKind
from schemas.observation import Observation
from schemas.outcome import Done, Dropped, Outcome
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.picture.predict import PicturePrediction, predict_picture
from tableverse_factory.models.services import Services
from tableverse_factory.stages.observe.depth.picture import check_table
from tableverse_factory.stages.observe.observe import observe
from tests.helpers.tabletop_views import Box, look

DATA = Path(skimage.__file__).parent / "data"
THINGS = (Box(-0.12, 0.05, (0.1, 0.06, 0.15)), Box(0.15, -0.05, (0.08, 0.08, 0.08), color=(40, 90, 200)))
WITHOUT_TABLE = (
    "brick.png",
    "chessboard_GRAY.png",
    "grass.png",
    "gravel.png",
    "hubble_deep_field.jpg",
    "ihc.png",
    "microaneurysms.png",
    "moon.png",
    "page.png",
    "rocket.jpg",
)
"""Of the pictures that scikit-image installs."""


def see(path: Path, **config: object) -> Outcome[Observation]:
    row = ImageRow(scene_id="x", kind=SceneKind.IMAGE, uri=str(path))
    return observe(row, Config.model_validate({"observe": config}), np.random.default_rng(0), Services(Path()))


def save(folder: Path, color: np.ndarray, **options: object) -> Path:
    Image.fromarray(color).save(folder / "picture.png", **options)
    return folder / "picture.png"


def predict(color: np.ndarray) -> PicturePrediction:
    height, width = color.shape[:2]
    focal = max(height, width) / (2 * np.tan(np.radians(29.0)))
    return predict_picture(color, Camera(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height))


def read_probability(outcome: Outcome[Observation]) -> float:
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "no_table"
    told = re.search(r"probability of ([01]\.\d\d), under observe\.min_table_probability = 0\.92$", outcome.detail)
    assert told, outcome.detail
    return float(told[1])


def make_plain(name: str) -> np.ndarray:
    rng, shape = np.random.default_rng(0), (480, 640, 3)
    ramps = (np.linspace(0, 255, n).astype(np.uint8) for n in shape[:2])
    down, right = next(ramps)[:, None, None], next(ramps)[None, :, None]
    sky = np.where(np.arange(480)[:, None, None] < 240, (120, 170, 230), (70, 120, 50))
    coarse = Image.fromarray(rng.integers(0, 256, (12, 16, 3), dtype=np.uint8))
    made = {
        "black": np.zeros(shape, np.uint8),
        "white": np.full(shape, 255, np.uint8),
        "grey": np.full(shape, 128, np.uint8),
        "red": np.broadcast_to(np.array([200, 30, 30], np.uint8), shape),
        "noise": rng.integers(0, 256, shape, dtype=np.uint8),
        "smooth noise": np.asarray(coarse.resize((640, 480), Image.Resampling.BICUBIC)),
        "down": np.broadcast_to(down, shape),
        "right": np.broadcast_to(right, shape),
        "sky and ground": np.broadcast_to(sky, shape).astype(np.uint8),
    }
    return np.ascontiguousarray(made[name])


@pytest.mark.heavy
@pytest.mark.parametrize(
    "name", [WITHOUT_TABLE[0], *(pytest.param(name, marks=pytest.mark.slow) for name in WITHOUT_TABLE[1:])]
)
def test_a_photograph_without_a_table_is_dropped(name: str) -> None:
    assert read_probability(see(DATA / name)) < 0.25


@pytest.mark.heavy
@pytest.mark.parametrize(
    "name",
    [
        "sky and ground",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in ("noise", "black", "white", "grey", "red", "smooth noise", "down", "right")
        ),
    ],
)
def test_what_shows_nothing_shows_no_table(name: str, tmp_path: Path) -> None:
    assert read_probability(see(save(tmp_path, make_plain(name)))) < 0.25


@pytest.mark.heavy
def test_the_coffee_cup_stands_on_a_table() -> None:
    outcome = see(DATA / "coffee.png")
    assert isinstance(outcome, Done), outcome
    seen = outcome.value
    assert (seen.scale_source, seen.intrinsics_source) == ("estimated", "assumed")
    assert 0 < seen.scale_sigma < 1
    assert seen.bend > 0
    assert seen.depth.shape == seen.color.shape[:2] == (400, 600)
    assert (seen.depth > 0).mean() > 0.9
    assert seen.camera.fx == pytest.approx(300 / np.tan(np.radians(29.0)))
    assert (seen.camera.cx, seen.camera.cy) == (299.5, 199.5)


@pytest.mark.slow  # two predictions, for one comparison
@pytest.mark.heavy
def test_the_least_probability_decides() -> None:
    taken = see(DATA / "rocket.jpg", min_table_probability=0.0)
    assert getattr(taken, "reason", "") != "no_table"
    refused = see(DATA / "coffee.png", min_table_probability=1.0)
    assert isinstance(refused, Dropped)
    assert refused.reason == "no_table"


@pytest.mark.heavy
def test_the_focal_length_comes_from_exif_then_the_configuration(tmp_path: Path) -> None:
    color = look(THINGS, floor_z=-0.7, wall_y=1.5)[0].color
    exif = Image.Exif()
    exif[0x010F] = "maker"  # Pillow writes no PNG's EXIF without a tag outside the IFD
    exif.get_ifd(0x8769)[0xA405] = 30  # millimetres on a film of 36 mm
    told = see(save(tmp_path, color, exif=exif), focal_px=900.0)
    assert isinstance(told, Done), told
    assert told.value.intrinsics_source == "exif"
    configured = see(save(tmp_path, color), focal_px=600.0)
    assert isinstance(configured, Done), configured
    assert configured.value.intrinsics_source == "assumed"
    assert configured.value.camera.fx == pytest.approx(600.0)
    assert told.value.camera.fx != pytest.approx(900.0, rel=0.01)


@pytest.mark.shared
@pytest.mark.heavy
def test_a_picture_of_a_long_lens_is_seen_with_a_narrower_angle(shared_dir: Path) -> None:
    """The capture has 1067 px; with the 577 px of the usual angle its table would be none."""
    picture = shared_dir / "captures" / "ycbv_000003" / "color.png"
    told = see(picture, focal_px=577.0)
    assert 0.5 < read_probability(told) < 0.92
    seen = see(picture)
    assert isinstance(seen, Done), seen
    assert seen.value.intrinsics_source == "model"
    assert seen.value.camera.fx == pytest.approx(1067.0, rel=0.03)


@pytest.mark.heavy
def test_the_plane_has_bounds() -> None:
    """Beyond each of them the picture is dropped, and what is wrong is said in numbers."""
    found, bounds = predict(look(THINGS, floor_z=-0.7, wall_y=1.5)[0].color), ObserveConfig()
    check_table(found, bounds)
    level, turned = np.array([0.0, -0.9998, -0.02]), np.array([-np.sin(0.8), -np.cos(0.8), 0.0])
    steep = np.array([0.0, 0.0, -1.0])
    check_table(replace(found, normal=steep), bounds)
    for wrong, words in (
        ({"distance_m": 0.05}, "0.05 m from the camera"),
        ({"distance_m": 4.5}, "4.50 m from the camera"),
        ({"normal": level}, "seen 1° down"),
        ({"normal": -steep}, "seen -90° down"),
        ({"normal": turned}, "tilted sideways by 46°"),
    ):
        with pytest.raises(AnswerInvalidError, match=words) as refused:
            check_table(replace(found, **wrong), bounds)
        assert refused.value.reason == "table_out_of_bounds"
    with pytest.raises(AnswerInvalidError) as refused:
        check_table(replace(found, table_probability=0.49, distance_m=9.0), bounds)
    assert refused.value.reason == "no_table"
