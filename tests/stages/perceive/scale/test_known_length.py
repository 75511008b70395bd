"""Known lengths give metres back, whatever the depth was multiplied by; a sensor is compared, not scaled."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.config import Config
from schemas.geometry import Camera
from schemas.known_length import KnownCameraHeight, KnownDistance, KnownHeight, KnownSheet
from schemas.observation import Observation
from schemas.outcome import Done, Dropped
from tableverse_factory.core.errors import InputError
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.perceive import perceive
from tableverse_factory.stages.perceive.scale.surface import measure_distance, measure_sheet
from tests.helpers.tabletop_views import SMALL_CAMERA, Box, camera_above, look

THINGS = (Box(-0.12, 0.05, (0.1, 0.06, 0.15)), Box(0.15, -0.05, (0.08, 0.08, 0.08)))
POSE = camera_above()
SIZES = {"a4": (0.297, 0.21), "us_letter": (0.2794, 0.2159), "bank_card": (0.0856, 0.05398)}


def pixel(*point):
    """The pixel that shows a point of the table frame."""
    x, y = project(transform_points(invert_pose(POSE), np.array([point], float)), SMALL_CAMERA)[0]
    return float(x), float(y)


def sheet(kind, x, y, yaw):
    width, height = SIZES[kind]
    cos, sin = np.cos(yaw), np.sin(yaw)
    corners = [(a * width / 2, b * height / 2) for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    return KnownSheet(
        kind=kind, pixels=tuple(pixel(x + cos * a - sin * b, y + sin * a + cos * b, 0) for a, b in corners)
    )


def distance(start, end, length_m=None):
    known_m = float(np.linalg.norm(np.subtract(start, end))) if length_m is None else length_m
    return KnownDistance(kind="distance", length_m=known_m, pixels=(pixel(*start), pixel(*end)))


KNOWN = {
    "across the table": distance((-0.3, -0.1, 0), (0.1, -0.1, 0)),
    "away from the camera": distance((0, -0.2, 0), (0, 0.3, 0)),
    "an edge of the box": distance((-0.17, 0.02, 0.15), (-0.07, 0.02, 0.15)),
    "its upright edge": distance((-0.07, 0.02, 0.15), (-0.07, 0.02, 0.0)),
    "a4": sheet("a4", 0.0, -0.2, 0.3),
    "us_letter": sheet("us_letter", -0.3, -0.1, -0.9),
    "bank_card": sheet("bank_card", 0.0, 0.05, 0.5),
    "the height of the box": KnownHeight(kind="height", length_m=0.15, pixels=(pixel(-0.12, 0.02, 0.06),)),
    "the camera's height": KnownCameraHeight(kind="camera_height", length_m=0.6),
}


TYPICAL = ("across the table", "a4", "the height of the box")
"""The fast run takes one of each kind, and the first alone where a case takes seconds."""


def typical(names, count=3):
    return [pytest.param(name, marks=[] if name in TYPICAL[:count] else [pytest.mark.slow]) for name in names]


@cache
def view():
    return look(THINGS, POSE, camera=SMALL_CAMERA)[0]


def estimated(factor, known, bend=0.0, **changes):
    depth = (view().depth * factor).astype(np.float32)
    return replace(view(), depth=depth, bend=bend, known_length=known, **{"scale_source": "estimated", **changes})


def perceived(item):
    detector = "auto" if item.bend else "geometric"  # a sensor's depth alone tells these boxes apart
    config = Config.model_validate({"perceive": {"detector": detector}})
    return perceive(item, config, np.random.default_rng(0), Services(Path("unused")))


def refusal(outcome):
    assert isinstance(outcome, Dropped), outcome
    assert outcome.detail.isprintable()
    return outcome.reason, outcome.detail


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("name", "factor"),
    [
        pytest.param(
            name, factor, marks=[] if factor == 0.7 or (factor == 3.0 and name in TYPICAL[:1]) else pytest.mark.slow
        )
        for name in KNOWN
        for factor in (0.7, 1.0, 3.0)
        if name != "its upright edge"
    ],
)
def test_a_known_length_brings_metres_back(name, factor):
    found = perceived(estimated(factor, KNOWN[name])).value
    np.testing.assert_allclose(found.observation.depth, view().depth, rtol=0.01)
    assert found.camera_to_table.position[2] == pytest.approx(0.6, rel=0.01)
    tops = [transform_points(POSE, item.points_camera)[:, 2].max() for item in found.objects]
    assert sorted(tops) == pytest.approx([0.08, 0.15], rel=0.02)
    assert found.observation.scale_source == "measured"
    assert 0.001 < found.observation.scale_sigma < 0.03


@pytest.mark.heavy
@pytest.mark.parametrize("factor", [0.7, *(pytest.param(factor, marks=pytest.mark.slow) for factor in (1.0, 3.0))])
def test_the_camera_stands_as_high_as_is_known_over_the_table_found_at_last(factor):
    found = perceived(estimated(factor, KNOWN["the camera's height"])).value
    assert found.camera_to_table.position[2] == pytest.approx(0.6, rel=1e-5)


@pytest.mark.heavy
@pytest.mark.parametrize("name", typical(KNOWN, 1))
def test_what_is_known_of_bent_depth_is_as_sure_as_it_says(name):
    """Over smooth bends of 1.2 %, the error stays within three of the stated deviations.

    Half a period further, a bend is the same with the other sign.
    """
    v, u = np.indices(view().depth.shape) / 240.0
    for phase in (0.0, 1.5):
        bent = 1 + 0.012 * np.sin(4 * u + phase) * np.cos(5 * v + phase)
        item = estimated(0.7, KNOWN[name], bend=0.015)
        found = perceived(replace(item, depth=(item.depth * bent).astype(np.float32))).value.observation
        seen = view().depth > 0
        error = float(np.median(np.log(found.depth[seen] / (bent * view().depth)[seen])))
        assert abs(error) < 3 * found.scale_sigma


@pytest.mark.heavy
@pytest.mark.parametrize("factor", [0.8, pytest.param(1.3, marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", typical(["across the table", "the height of the box", "the camera's height"], 1))
def test_scaling_depth_and_length_alike_scales_the_scene(name, factor):
    known = KNOWN[name]
    larger = known.model_copy(update={"length_m": factor * known.length_m})
    plain, scaled = perceived(estimated(1.0, known)).value, perceived(estimated(factor, larger)).value
    np.testing.assert_allclose(scaled.observation.depth, factor * plain.observation.depth, rtol=0.003)
    np.testing.assert_allclose(scaled.camera_to_table.position, factor * plain.camera_to_table.position, atol=0.003)
    sizes = [[np.ptp(o.points_camera, axis=0) for o in found.objects] for found in (plain, scaled)]
    np.testing.assert_allclose(sizes[1], factor * np.array(sizes[0]), atol=0.006)  # less than two pixels


@pytest.mark.parametrize("factor", [0.19, 5.5])
@pytest.mark.parametrize("name", ["across the table", "a4", "the height of the box", "the camera's height"])
def test_a_factor_beyond_its_bounds_is_dropped(name, factor):
    if name == "the height of the box" and factor > 1:
        factor = 0.19
    reason, detail = refusal(perceived(estimated(1.0 / factor, KNOWN[name])))
    assert reason == "scale_implausible"
    assert "outside 0.2 to 5" in detail


@pytest.mark.parametrize("name", typical(["across the table", "a4", "the height of the box", "the camera's height"], 1))
def test_a_known_length_says_how_far_it_is_from_what_was_estimated(name):
    """A depth 0.7 of the truth, stated to 15 %, is made larger by 2.4 deviations; what tells no deviation has none."""
    for factor in (0.7, 1.4):
        found = perceived(estimated(factor, KNOWN[name], scale_sigma=0.15)).value.observation
        assert found.scale_deviation == pytest.approx(-np.log(factor) / 0.15, rel=0.1)
    assert perceived(estimated(0.7, KNOWN[name])).value.observation.scale_deviation is None


@pytest.mark.parametrize("name", typical(KNOWN))
def test_a_sensor_that_agrees_is_left_as_it_is(name):
    item = estimated(1.03, KNOWN[name], scale_source="sensor")
    found = perceived(item).value.observation
    np.testing.assert_array_equal(found.depth, item.depth)
    assert (found.scale_source, found.scale_sigma) == ("sensor", 0.0)


@pytest.mark.parametrize("name", KNOWN)
def test_a_sensor_that_contradicts_is_a_reason(name):
    reason, detail = refusal(perceived(estimated(1.2, KNOWN[name], scale_source="sensor")))
    assert reason == "scale_contradicts_sensor"
    assert "check the length, its pixels and depth_scale" in detail


SHORT = distance((0.0, -0.1, 0), (0.016, -0.1, 0))


@pytest.mark.parametrize(
    ("known", "told"),
    [
        (KnownDistance(kind="distance", length_m=0.3, pixels=((0.0, 0.0), (150.0, 150.0))), "mark another pixel"),
        (SHORT, "too uncertain; mark a longer length"),
        (KnownSheet(kind="a4", pixels=((5.0, 5.0), (15.0, 5.0), (15.0, 15.0), (5.0, 15.0))), "0 depth readings"),
        (KnownSheet(kind="a4", pixels=((100.0, 150.0), (210.0, 150.0), (210.0, 160.0), (100.0, 160.0))), "make no a4"),
        (KnownHeight(kind="height", length_m=0.1, pixels=((160.0, 235.0),)), "no object is found at the pixel"),
        (KnownHeight(kind="height", length_m=0.1, label="mug"), "0 objects are called 'mug' (labels: object)"),
        (KnownHeight(kind="height", length_m=0.1, label="object"), "2 objects are called 'object'"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_length_that_cannot_be_measured_is_a_reason(known, told):
    item = estimated(1.0, known)
    depth = item.depth.copy()
    depth[:30, :30] = 0.0
    reason, detail = refusal(perceived(replace(item, depth=depth)))
    assert reason == "known_length_unmeasured"
    assert told in detail


def test_without_a_known_length_nothing_is_measured():
    item = estimated(0.7, None, scale_sigma=0.12)
    found = perceived(item)
    assert isinstance(found, Done)
    assert found.value.observation is item


def plane_view(normal, offset_m, camera):
    """An observation that shows one plane alone."""
    v, u = np.indices((camera.height, camera.width), dtype=float)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    depth = (offset_m / (rays @ np.array(normal))).astype(np.float32)
    color = np.zeros((camera.height, camera.width, 3), np.uint8)
    return Observation("view", color, depth, camera)


@given(
    st.floats(-0.4, 0.4), st.floats(-0.7, 0.0), st.floats(0.4, 2.0), st.floats(0.3, 3.0),
    st.tuples(*[st.floats(10, 140)] * 4), st.sampled_from([300.0, 150.0]),
)  # fmt: skip
def test_a_distance_on_any_plane_is_measured_as_it_is(x, y, offset_m, factor, ends, focal):
    camera = Camera(focal, focal, 79.5, 59.5, 160, 120)
    item = plane_view((x, y, 1.0), offset_m, camera)
    pixels = ((ends[0], ends[1] * 0.75), (ends[2], ends[3] * 0.75))
    rays = np.array([[(u - 79.5) / focal, (v - 59.5) / focal, 1.0] for u, v in pixels])
    points = rays * (offset_m / (rays @ [x, y, 1.0]))[:, None]
    true_m = float(np.linalg.norm(points[0] - points[1]))
    if true_m < 0.02 or np.hypot(*np.subtract(*pixels)) < 5:
        return
    known = KnownDistance(kind="distance", length_m=min(true_m, 10.0), pixels=pixels)
    found = measure_distance(replace(item, depth=item.depth * np.float32(factor)), known)
    assert found.length_m == pytest.approx(true_m * factor, rel=1e-3)
    assert np.isfinite(found.sigma)


@pytest.mark.slow  # forty random depths
@settings(max_examples=40)
@given(st.integers(0, 2**32 - 1), st.floats(0.3, 3.0))
def test_any_depth_gives_a_finite_length_or_a_reason(seed, factor):
    """Holes, steps and noise: nothing else is raised, and no NaN comes out."""
    rng = np.random.default_rng(seed)
    camera = Camera(60.0, 60.0, 31.5, 23.5, 64, 48)
    depth = rng.choice([0.0, 0.5, 0.52, 1.0, 3.0], (48, 64)) * factor * (rng.random((48, 64)) < rng.random())
    item = replace(plane_view((0.0, 0.0, 1.0), 1.0, camera), depth=depth.astype(np.float32))
    u, v = rng.uniform(0, 63, 2), rng.uniform(0, 47, 2)
    ends = ((float(u[0]), float(v[0])), (float(u[0] + 32) % 63, float(v[1])))
    corners = ((5.0, 6.0), (50.0, 4.0), (58.0, 40.0), (3.0, 44.0))
    for measure, known in (
        (measure_distance, KnownDistance(kind="distance", length_m=0.3, pixels=ends)),
        (measure_sheet, KnownSheet(kind="a4", pixels=corners)),
    ):
        try:
            found = measure(item, known)
        except InputError as error:
            assert error.reason == "known_length_unmeasured"  # noqa: PT017
            continue
        assert found.length_m > 0.0
        assert np.isfinite([found.length_m, found.sigma]).all()
