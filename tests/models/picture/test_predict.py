"""The net says the same of the same picture, something of every picture, and the mirrored of a mirrored one."""

import hashlib
import subprocess
import sys
from dataclasses import fields
from itertools import product

import numpy as np
import pytest

from schemas.geometry import Camera
from tableverse_factory.models.picture import predict as predict_module
from tableverse_factory.models.picture.instances import upsample_ids
from tableverse_factory.models.picture.net import REACHES
from tableverse_factory.models.picture.predict import (
    LEAST_PIXELS,
    MOST_PIXELS,
    OBJECT,
    PicturePrediction,
    choose_working_size,
    compute_rays,
    predict_picture,
    predict_window,
)
from tests.helpers.paths import ROOT
from tests.helpers.tabletop_views import Box, look

THINGS = (Box(-0.12, 0.05, (0.1, 0.06, 0.15)), Box(0.15, -0.05, (0.08, 0.08, 0.08), color=(40, 90, 200)))


def draw() -> np.ndarray:
    """Two boxes on a table in a room, (480, 640, 3)."""
    return look(THINGS, floor_z=-0.7, wall_y=1.5)[0].color


def make_camera(color: np.ndarray, focal_px: float = 577.0) -> Camera:
    height, width = color.shape[:2]
    return Camera(focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, width, height)


def predict(color: np.ndarray, focal_px: float = 577.0) -> PicturePrediction:
    return predict_picture(color, make_camera(color, focal_px))


def digest(found: PicturePrediction) -> str:
    parts = (np.asarray(getattr(found, one.name)).tobytes() for one in fields(found) if one.name != "camera")
    return hashlib.sha256(b"".join(parts) + repr(found.camera).encode()).hexdigest()


def check_sound(found: PicturePrediction, rows: int, columns: int) -> None:
    """Every field has its shape and its bounds."""
    assert found.depth.shape == found.boundary.shape == (rows, columns)
    assert found.label.shape == (3, rows, columns)
    assert found.votes.shape == (2, rows, columns)
    for one in fields(found):
        if one.name != "camera":
            assert np.isfinite(getattr(found, one.name)).all(), one.name
    assert (found.depth > 0).all()
    np.testing.assert_allclose(found.label.sum(axis=0), 1.0, atol=1e-5)
    assert 0 <= found.boundary.min() <= found.boundary.max() <= 1
    assert 0 <= found.table_probability <= 1
    assert np.linalg.norm(found.normal) == pytest.approx(1.0)
    assert found.scale_sigma > 0


@pytest.mark.heavy
def test_two_processes_say_the_same_to_the_byte() -> None:
    code = "from tests.models.picture.test_predict import *; print(digest(predict(draw())))"
    said = subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    assert said.strip() == digest(predict(draw()))


@pytest.mark.parametrize(
    ("picture", "size"),
    [
        ((480, 640), (288, 384)),
        ((3000, 4000), (288, 384)),
        ((640, 480), (384, 288)),
        ((1080, 1920), (256, 448)),
        ((1920, 1080), (448, 256)),
        ((500, 500), (320, 320)),
        ((8, 8), (320, 320)),
        ((100, 800), (96, 800)),
    ],
    ids=str,
)
def test_the_working_size_keeps_the_aspect(picture: tuple[int, int], size: tuple[int, int]) -> None:
    assert choose_working_size(*picture) == size


def test_working_sizes_of_every_aspect_are_ones_that_the_net_can_have() -> None:
    for aspect in np.geomspace(1 / 8, 8, 201):
        rows, columns = choose_working_size(round(1000 * aspect**0.5), round(1000 / aspect**0.5))
        assert rows % 32 == columns % 32 == 0
        assert LEAST_PIXELS <= rows * columns <= MOST_PIXELS
        is_usual = 1 / 6 <= aspect <= 6
        assert abs(np.log(rows / columns / aspect)) < (0.05 if is_usual else 0.09)


def test_rays_are_unit_and_mirror_about_the_axis() -> None:
    rays = compute_rays(Camera(50.0, 60.0, 15.5, 11.5, 32, 24))
    np.testing.assert_allclose(np.linalg.norm(rays, axis=0), 1.0, atol=1e-6)
    np.testing.assert_allclose(rays[:, :, ::-1], rays * np.array([-1, 1, 1])[:, None, None], atol=1e-6)
    np.testing.assert_allclose(rays[:2, 0, 0] / rays[2, 0, 0], [-15.5 / 50, -11.5 / 60], atol=1e-6)


@pytest.mark.heavy
def test_the_mirrored_picture_has_the_mirrored_depth_and_things() -> None:
    color = draw()
    found, mirrored = predict(color), predict(np.ascontiguousarray(color[:, ::-1]))
    off = np.abs(mirrored.depth[:, ::-1] / found.depth * np.median(found.depth / mirrored.depth[:, ::-1]) - 1)
    assert np.median(off) < 0.05
    assert np.quantile(off, 0.95) < 0.15
    true = upsample_ids((look(THINGS)[1] > 1).astype(np.int32), found.depth.shape) > 0
    things, others = found.label.argmax(axis=0) == OBJECT, mirrored.label.argmax(axis=0)[:, ::-1] == OBJECT
    assert (things & others).sum() > 0.9 * (things | others).sum() > 0
    assert (things & true).sum() > 0.8 * (things | true).sum()
    assert (things & (mirrored.label.argmax(axis=0) == OBJECT)).sum() < 0.5 * things.sum()
    np.testing.assert_allclose(mirrored.normal * [-1, 1, 1], found.normal, atol=0.05)


def answer(ids: np.ndarray) -> dict[str, np.ndarray]:
    """What a faultless net would say of things with these ids, (h, w): of their pairs, votes and the plane."""
    height, width = ids.shape
    votes, affinity = np.zeros((2, height, width), np.float32), np.zeros((6, height, width), np.float32)
    for thing in np.unique(ids[ids > 0]):
        at = np.argwhere(ids == thing)
        votes[:, *at.T] = (at.mean(axis=0) - at).T[::-1]
    for own, (reach, axis) in zip(affinity, product(REACHES, (1, 0)), strict=True):
        ends = (
            np.moveaxis(own, axis, 0)[:-reach],
            *(np.moveaxis(ids, axis, 0)[part] for part in (np.s_[:-reach], np.s_[reach:])),
        )
        ends[0][...] = np.where(ends[1] == ends[2], 1.0, -1.0)
    return {"votes": votes, "affinity": affinity, "plane": np.array([0.6, 0.0, -0.8, 1.0], np.float32)}


def test_answers_about_the_mirrored_picture_are_turned_back() -> None:
    ids = np.zeros((40, 60), np.int32)
    ids[5:20, 8:30], ids[12:35, 30:41] = 1, 2
    true, about_mirrored = answer(ids), answer(ids[:, ::-1])
    about_mirrored["plane"][0] *= -1.0
    found = predict_module._mirror(about_mirrored)
    np.testing.assert_allclose(found["votes"], true["votes"], atol=1e-5)
    np.testing.assert_array_equal(found["plane"], true["plane"])
    inside = 60 - max(REACHES)  # pairs beyond the right edge mean nothing
    np.testing.assert_array_equal(found["affinity"][:, :, :inside], true["affinity"][:, :, :inside])


@pytest.mark.slow  # two predictions more, of how good the net is
@pytest.mark.heavy
def test_a_picture_upside_down_is_answered() -> None:
    color = draw()
    turned = predict(np.ascontiguousarray(color[::-1, ::-1]))
    check_sound(turned, 288, 384)
    assert turned.table_probability < predict(color).table_probability


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("size", "value"),
    [
        ((8, 64), 255),
        *(
            pytest.param(size, value, marks=pytest.mark.slow)
            for size, value in product([(1, 1), (8, 8), (8, 64), (480, 640)], [0, 255])
            if (size, value) != ((8, 64), 255)
        ),
    ],
    ids=str,
)
def test_a_tiny_or_single_coloured_picture_is_answered(size: tuple[int, int], value: int) -> None:
    found = predict(np.full((*size, 3), value, np.uint8), float(max(size)))
    check_sound(found, *choose_working_size(*size))
    assert found.table_probability < 0.5


@pytest.mark.slow  # four predictions, for a store of one answer
@pytest.mark.heavy
def test_a_prediction_is_remembered_for_this_picture_and_camera_alone() -> None:
    color = draw()
    first = predict(color)
    assert predict(color.copy()) is first
    nearer = predict(color, 700.0)
    assert nearer is not first
    assert not np.array_equal(nearer.depth, first.depth)
    again = predict(color)
    assert again is not first, "only the latest is kept"
    assert digest(again) == digest(first)
    spotted = color.copy()
    spotted[0, 0] ^= 1
    assert predict(spotted) is not again


@pytest.mark.slow  # two predictions
@pytest.mark.heavy
def test_the_depth_of_a_sensor_is_another_question() -> None:
    seen = look(THINGS, floor_z=-0.7, wall_y=1.5)[0]
    bare, sensed = predict_picture(seen.color, seen.camera), predict_picture(seen.color, seen.camera, seen.depth)
    assert sensed is not bare
    assert predict_picture(seen.color, seen.camera, seen.depth.copy()) is sensed
    wrong = predict_picture(seen.color, seen.camera, np.roll(seen.depth, 40, axis=1))
    assert wrong is not sensed


@pytest.mark.parametrize(
    ("window", "grown"),
    [
        pytest.param(np.s_[100:400, 200:500], np.s_[100:400, 190:510], marks=pytest.mark.slow),
        pytest.param(np.s_[0:20, 630:700], np.s_[0:240, 320:640], marks=pytest.mark.slow),
        (np.s_[470:480, 0:5], np.s_[240:480, 0:320]),
    ],
    ids=["middle", "corner", "other corner"],
)
def test_a_window_is_seen_in_its_place_and_nothing_around_it(
    window: tuple[slice, slice], grown: tuple[slice, slice]
) -> None:
    seen = look(THINGS, floor_z=-0.7, wall_y=1.5)[0]
    found = predict_window(seen.color, seen.camera, seen.depth, window)
    check_sound(found, *found.depth.shape)
    assert (found.camera.height, found.camera.width) == found.depth.shape
    objects = upsample_ids((found.label[OBJECT] > 0.5).astype(np.int32), seen.depth.shape) > 0
    around = np.ones(seen.depth.shape, dtype=bool)
    around[grown] = False
    assert not (objects & around).any()
    whole = predict_picture(seen.color, seen.camera, seen.depth)
    wanted = (upsample_ids((whole.label[OBJECT] > 0.5).astype(np.int32), seen.depth.shape) > 0) & ~around
    assert (objects != wanted).sum() <= 0.1 * wanted.sum()
