"""`bench picture`: what a capture's colour gives, against its own depth; a folder without captures is refused."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import skimage
from PIL import Image

from schemas.config import Config
from schemas.geometry import TABLE_ID
from schemas.outcome import Done
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.bench.marked_sheet import mark_sheet
from tableverse_factory.evaluation.bench.picture import (
    PictureScore,
    compare_depth,
    measure_angle_deg,
    resize_nearest,
    summarize_pictures,
)
from tableverse_factory.evaluation.bench.picture_shapes import ProportionError, ShapeScore, compare_proportions
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.models.services import Services
from tableverse_factory.sources.manifest import make_manifest
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures
from tableverse_factory.stages.observe.observe import observe
from tableverse_factory.stages.perceive.perceive import perceive
from tests.helpers.tabletop_views import GEOMETRIC, Box, look

DATA = Path(skimage.__file__).parent / "data"


def make_score(**changed: object) -> PictureScore:
    given = {
        "name": "a",
        "depth_error": 0.02,
        "log_scale": 0.1,
        "scale_sigma": 0.2,
        "plane_deg": 1.0,
        "cpu_s": 0.5,
        "measured_error": 0.03,
    }
    return PictureScore(**{**given, **changed})


def test_one_scale_is_taken_out_of_the_depth() -> None:
    true = np.random.default_rng(0).uniform(0.5, 1.5, (40, 50)).astype(np.float32)
    wanted = np.ones(true.shape, bool)
    error, log_scale = compare_depth(true / 1.25, true, wanted)
    assert error == pytest.approx(0.0, abs=1e-6)
    assert log_scale == pytest.approx(math.log(1.25), abs=1e-6)
    off = np.where(np.indices(true.shape).sum(axis=0) % 4 == 0, 1.1, 1.0)
    assert compare_depth((true * off).astype(np.float32), true, wanted)[0] == pytest.approx(0.025, abs=1e-3)


def test_depth_is_compared_where_both_know_it_and_it_is_wanted() -> None:
    true, found = np.ones((40, 50), np.float32), np.ones((40, 50), np.float32)
    true[:20], found[20:30], wanted = 0.0, 0.0, np.ones((40, 50), bool)
    wanted[38:] = False
    found[38:] = 9.0
    assert compare_depth(found, true, wanted) == (0.0, 0.0)
    wanted[31:] = False
    assert np.isnan(compare_depth(found, true, wanted)).all(), "50 pixels tell no scale"


def test_angles_and_sizes() -> None:
    up, tilted = np.array([0.0, 0.0, 1.0]), np.array([0.0, math.sin(0.1), math.cos(0.1)])
    assert measure_angle_deg(up, tilted) == pytest.approx(math.degrees(0.1))
    assert measure_angle_deg(up, -up) == pytest.approx(180.0)
    image = np.arange(12).reshape(3, 4)
    np.testing.assert_array_equal(resize_nearest(np.kron(image, np.ones((5, 5), int)), (3, 4)), image)


def test_the_summary_counts_what_was_dropped_and_averages_the_rest() -> None:
    nothing = float("nan")
    dropped = {"depth_error": nothing, "log_scale": nothing, "scale_sigma": nothing, "plane_deg": nothing}
    scores = [
        make_score(),
        make_score(depth_error=0.04, log_scale=-0.3, plane_deg=3.0),
        make_score(**dropped, reason="no_table"),
    ]
    total = summarize_pictures(scores)
    assert (total.pictures, total.dropped, total.masks) == (3, 1, None)
    assert (total.depth_error, total.plane_deg, total.within_sigma) == pytest.approx((0.03, 2.0, 0.5))
    assert total.scale_error == pytest.approx((abs(math.expm1(-0.1)) + math.expm1(0.3)) / 2)


@pytest.mark.slow  # figures of a bench
@pytest.mark.heavy
@pytest.mark.shared
def test_the_table_of_a_real_capture(tmp_path, run, shared_dir) -> None:
    captures = tmp_path / "captures"
    captures.mkdir()
    (captures / "osd_test14").symlink_to(shared_dir / "captures" / "osd_test14")
    others = tmp_path / "others"
    others.mkdir()
    Image.open(DATA / "rocket.jpg").save(others / "rocket.png")
    code, said, errors = run("bench", "picture", captures, "--other", others)
    assert code == 0, errors
    for word in ("osd_test14", "depth %", "scale %", "mean IoU", "CPU s", "within one stated standard deviation"):
        assert word in said
    assert "without a table: 1 of 1 dropped; kept: none" in said
    code, said, errors = run("bench", "picture", captures, "--shapes")
    assert code == 0, errors
    assert "height over width off by" in said
    code, said, errors = run("bench", "picture", captures, "--json")
    assert code == 0, errors
    (score,) = json.loads(said)["pictures"]
    assert not score["reason"]
    assert 0 < score["depth_error"] < 0.1
    assert score["scale_sigma"] > 0
    assert score["plane_deg"] < 15


def test_a_folder_without_captures_is_refused(tmp_path, run) -> None:
    code, _, errors = run("bench", "picture", tmp_path)
    assert code != 0
    assert "holds no capture" in errors
    assert "camera.json" in errors


@pytest.mark.slow  # measures a picture first
@pytest.mark.heavy
def test_a_folder_without_other_pictures_is_refused(tmp_path, run) -> None:
    synthesize_captures(tmp_path / "captures", 1, 0)
    (tmp_path / "others").mkdir()
    code, _, errors = run("bench", "picture", tmp_path / "captures", "--other", tmp_path / "others")
    assert code != 0
    assert "holds no picture" in errors
    (tmp_path / "others" / "notes.txt").write_text("no picture, and no table either")
    code, _, errors = run("bench", "picture", tmp_path / "captures", "--other", tmp_path / "others")
    assert code != 0
    assert "notes.txt" in errors


@pytest.mark.heavy
def test_the_proportions_of_the_same_scene_at_another_scale_are_the_same(tmp_path) -> None:
    capture = synthesize_captures(tmp_path, 1, 38)[0]
    config = Config()
    row = make_manifest([str(capture)], config.observe).rows[0]
    seen = observe(row, config, make_rng(0, "a", "observe"), Services(Path())).value
    sensed, larger = (
        perceive(replace(seen, depth=seen.depth * scale), config, make_rng(0, "a", "perceive"), Services(Path())).value
        for scale in (1.0, np.float32(1.25))
    )
    sensed, larger = (replace(found, objects=found.objects[:3]) for found in (sensed, larger))  # three tell as much
    score = compare_proportions(larger, larger.instance_ids, sensed, config)
    errors = score.proportions
    assert 0 < len(errors) <= score.objects
    assert np.median([abs(thing.log_ratio) for thing in errors]) < 0.05
    moved = np.roll(larger.instance_ids, larger.instance_ids.shape[1] // 2, axis=1)
    other = compare_proportions(larger, moved, sensed, config)
    assert len(other.proportions) < len(errors), "masks tell which thing it is"


def test_too_flat_and_too_high_count_alike() -> None:
    flat, high = (ProportionError("a", "b", "carved/box", math.log(ratio)) for ratio in (0.5, 2.0))
    scores = [make_score(shapes=ShapeScore(3, things)) for things in ((flat,), (high, high), ())]
    total = summarize_pictures([*scores, make_score()])
    assert total.proportion_error == pytest.approx(1.0)
    assert math.isnan(summarize_pictures([make_score()]).proportion_error)


@pytest.mark.slow  # figures of a bench
@pytest.mark.heavy
def test_a_capture_that_cannot_be_read_costs_its_own_row(tmp_path, run) -> None:
    good, bad = synthesize_captures(tmp_path / "captures", 2, 5)
    (bad / "depth.png").write_bytes(b"no picture")
    code, said, errors = run("bench", "picture", good.parent, "--json")
    assert code == 0, errors
    rows = json.loads(said)["pictures"]
    assert [row["unread"] for row in rows] == [False, True]
    assert "depth.png" in rows[1]["reason"]
    assert json.loads(said)["all"]["unread"] == 1
    (good / "depth.png").write_bytes(b"no picture")
    code, _, errors = run("bench", "picture", good.parent)
    assert code != 0
    assert "none of 2 captures could be read" in errors


def test_a_sheet_is_marked_where_nothing_stands_and_as_large_as_it_is(tmp_path: Path) -> None:
    thing = Box(0.0, 0.0, (0.08, 0.08, 0.1))
    seen, _ = look([thing])
    truth = perceive(seen, GEOMETRIC, np.random.default_rng(0), Services(tmp_path))
    assert isinstance(truth, Done), truth
    known = mark_sheet(truth.value, np.random.default_rng(0))
    assert known is not None
    camera, pose = seen.camera, truth.value.camera_to_table
    offsets = (np.array(known.pixels) - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    directions = np.append(offsets, np.ones((4, 1)), axis=1) @ rotation_matrix(pose.quaternion_wxyz).T
    corners = pose.position - directions * (pose.position[2] / directions[:, 2:])
    sides = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
    assert np.sort(sides) == pytest.approx([0.21, 0.21, 0.297, 0.297], abs=0.01)
    columns, rows = np.array(known.pixels).mean(axis=0).round().astype(int)
    assert truth.value.instance_ids[rows, columns] == TABLE_ID


def test_a_small_table_has_no_room_for_a_sheet(tmp_path: Path) -> None:
    seen, _ = look([Box(0.0, 0.0, (0.08, 0.08, 0.1))], table_half=(0.14, 0.1))
    truth = perceive(seen, GEOMETRIC, np.random.default_rng(0), Services(tmp_path))
    assert isinstance(truth, Done), truth
    assert mark_sheet(truth.value, np.random.default_rng(0)) is None
