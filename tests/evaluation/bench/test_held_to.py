"""What the factory is held to, measured by its own benches on real captures and on synthetic ones with known truth."""

import numpy as np
import pytest

from schemas.config import Config, PerceiveConfig
from tableverse_factory.evaluation.bench.perception import bench_masks, merge_scores
from tableverse_factory.evaluation.bench.placement import bench_placement
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures


@pytest.mark.slow  # figures of a bench, of real captures
@pytest.mark.heavy
@pytest.mark.shared
def test_objects_of_real_captures_are_found_without_weights(shared_dir):
    config = Config(perceive=PerceiveConfig(detector="geometric"))
    score = merge_scores(list(bench_masks(shared_dir / "captures", config)))
    assert score.recall >= 0.97
    assert score.mean_iou >= 0.93


@pytest.mark.slow
@pytest.mark.parametrize("meshes", ["carved", "replay"])
def test_placed_objects_of_synthetic_captures_are_where_and_as_large_as_they_are(tmp_path, meshes):
    synthesize_captures(tmp_path / "captures", 3, seed=21)
    way = ("replay", meshes)
    placements = [entry for found in bench_placement(tmp_path / "captures", Config(), (way,)) for entry in found[way]]
    placed = [entry for entry in placements if entry.completion]
    assert len(placed) >= 0.8 * len(placements)
    assert np.median([entry.position_error_m for entry in placed]) <= 0.006
    assert np.nanmedian([entry.heading_error_rad for entry in placed if entry.symmetry == 1]) <= np.deg2rad(8.0)
    assert np.median([entry.size_error for entry in placed]) <= 0.08
