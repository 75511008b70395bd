"""Columns about what toppled, slid, is left out, explained and covered."""

import io
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from schemas.config import Config
from schemas.geometry import Pose
from schemas.objects import Evidence, Explanation
from schemas.outcome import Done
from schemas.scene import Coverage
from tableverse_factory.core.png import encode_png
from tableverse_factory.geometry.math.transforms import quaternion_from_rotation_vector
from tableverse_factory.models.services import Services
from tableverse_factory.stages.export.export import export
from tests.helpers.simple_scenes import Solid, as_settled, box, curated, layout
from tests.helpers.tabletop_views import CAMERA, camera_above

SOLIDS = [Solid(box(0.08, 0.08, 0.08), (x, 0.0, 0.04)) for x in (-0.15, 0.0, 0.15)]
STRAIGHT = np.array([1.0, 0.0, 0.0, 0.0])


def exported(residual_m=0.0, **changes):
    """The scene of three boxes, of which the picture placed the second lying and the third elsewhere."""
    settled = as_settled(layout(SOLIDS))
    scene = curated(settled)
    placed = settled.rectified.placed
    lying = quaternion_from_rotation_vector(np.array([np.pi / 2, 0.0, 0.0]))
    stays, second, third = placed.objects
    stays = replace(stays, fit_residual_m=residual_m)
    moved = Pose(np.array([0.15, 0.06, 0.04]), STRAIGHT)
    objects = (stays, replace(second, pose=Pose(np.array([0.0, 0.0, 0.04]), lying)), replace(third, pose=moved))
    placed = replace(placed, objects=objects, **changes)
    settled = replace(settled, rectified=replace(settled.rectified, placed=placed))
    scene = replace(scene, settled=settled, coverage=Coverage(0.7, (0.9, 0.8, 0.3)))
    outcome = export(scene, Config(), np.random.default_rng(0), Services(Path("unused")))
    assert isinstance(outcome, Done)
    return outcome.value


def test_rows_tell_what_moved_away_and_what_is_shown():
    explanation = Explanation(100, 2.0, (("obj_000", 30, 0.5), ("obj_001", 40, 1.0), ("obj_009", 30, 0.5)))
    scene = exported(explanation=explanation, left_out=(("obj_009", "too few points"),))
    row, items = scene.scene_row, scene.object_rows
    assert (row["n_toppled"], row["n_slid"], row["n_left_out"]) == (1, 1, 1)
    assert row["twin_remarks"] == ["toppled:obj_001", "slid:obj_002", "left_out:obj_009", "poorly_covered:obj_002"]
    assert (row["explained_points"], row["explained_area"]) == (pytest.approx(0.7), pytest.approx(0.75))
    assert row["coverage"] == 0.7
    assert [item["coverage"] for item in items] == [0.9, 0.8, 0.3]
    assert [item["tilt_rad"] for item in items] == pytest.approx([0.0, np.pi / 2, 0.0], abs=1e-3)


@pytest.mark.parametrize(("residual_m", "remarks"), [(0.009, []), (0.025, ["misfit:obj_000"])])
def test_a_shape_far_from_what_was_read_is_named(residual_m, remarks):
    masks, eye = encode_png(np.zeros((CAMERA.height, CAMERA.width), np.uint16)), camera_above(1.0)
    picture = io.BytesIO()
    Image.new("RGB", (CAMERA.width, CAMERA.height)).save(picture, "JPEG")
    evidence = Evidence(picture.getvalue(), masks, (1, 2, 3), CAMERA, eye)
    named = exported(residual_m, evidence=evidence).scene_row["twin_remarks"]
    assert [name for name in named if name.startswith("misfit")] == remarks


def test_a_layout_has_no_photograph_to_explain():
    row = exported().scene_row
    assert (row["explained_points"], row["explained_area"]) == (None, None)
    assert row["n_toppled"] == 1
