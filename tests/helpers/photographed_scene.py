"""A small scene that is really exported, with or without the photograph that it was seen in."""

import io
from pathlib import Path

import numpy as np
from PIL import Image

from schemas.config import Config
from schemas.geometry import Camera, Pose
from schemas.objects import Evidence
from schemas.outcome import Done
from schemas.scene import ExportedScene
from tableverse_factory.geometry.math.transforms import normalize_quaternion
from tableverse_factory.models.services import Services
from tableverse_factory.stages.export.export import export
from tests.helpers.simple_scenes import Solid, as_settled, ball, box, curated, layout

SOLIDS = [Solid(box(0.1, 0.08, 0.04), (0.0, 0.0, 0.02)), Solid(ball(0.03), (0.15, 0.05, 0.03))]


def evidence() -> Evidence:
    jpg, png = io.BytesIO(), io.BytesIO()
    Image.new("RGB", (320, 240), (150, 120, 90)).save(jpg, "JPEG")
    Image.fromarray(np.zeros((240, 320), dtype=np.uint16)).save(png, "PNG")
    eye = Pose(np.array([0.0, -0.5, 0.5]), normalize_quaternion(np.array([0.38, -0.92, 0.0, 0.0])))
    return Evidence(jpg.getvalue(), png.getvalue(), (1, 2), Camera(300, 300, 159.5, 119.5, 320, 240), eye)


def box_and_ball(photographed: bool) -> ExportedScene:
    settled = as_settled(layout(SOLIDS, evidence=evidence() if photographed else None))
    outcome = export(curated(settled), Config(), np.random.default_rng(0), Services(Path("unused")))
    assert isinstance(outcome, Done)
    return outcome.value
