"""Cluttered layouts of scanned meshes, from file to certificate."""

from pathlib import Path

import numpy as np
import pytest

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done
from tableverse_factory.evaluation.scene_audit import audit_scene
from tableverse_factory.models.services import Services
from tableverse_factory.stages.export.export import export
from tableverse_factory.stages.observe.observe import read_layout
from tableverse_factory.stages.rectify.rectify import rectify
from tableverse_factory.stages.settle import settle
from tests.helpers.simple_scenes import curated

pytestmark = [pytest.mark.shared, pytest.mark.slow]


@pytest.mark.parametrize("name", ["clutter_014", "clutter_018", "clutter_052"])  # the three hardest to bring to rest
def test_a_layout_leaves_at_rest_and_free(shared_dir: Path, tmp_path: Path, name: str) -> None:
    row = ImageRow(scene_id=name, kind=SceneKind.LAYOUT, uri=str(shared_dir / "layouts" / f"{name}.json"))
    item, config, services = row, Config(), Services(tmp_path)
    for stage in (read_layout, rectify, settle):
        outcome = stage(item, config, np.random.default_rng(0), services)  # type: ignore[arg-type]
        assert isinstance(outcome, Done), outcome
        item = outcome.value
    outcome = export(curated(item), config, np.random.default_rng(0), services)  # type: ignore[arg-type]
    assert isinstance(outcome, Done), outcome
    certificate = outcome.value.certificate
    assert certificate.at_rest
    assert certificate.drift_m < 1e-3
    assert max(certificate.piece_penetration_before_m, certificate.mesh_penetration_before_m) < 1e-4
    assert max(certificate.piece_penetration_m, certificate.mesh_penetration_m) < 1e-3
    assert audit_scene(name, dict(outcome.value.files), outcome.value.scene_row).problems == ()
