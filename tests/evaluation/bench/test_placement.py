import json
from pathlib import Path

import numpy as np
import pytest

from schemas.config import Config
from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.bench.placement import bench_placement
from tableverse_factory.sources.synthetic.synthesize import synthesize_captures

WAY = ("replay", "replay")


@pytest.mark.slow  # figures of a bench
@pytest.mark.heavy
def test_a_true_mesh_is_placed_where_and_as_large_as_it_is(tmp_path: Path) -> None:
    (capture,) = synthesize_captures(tmp_path, 1, seed=3)
    content = json.loads((capture / "truth.json").read_text())
    content["objects"] = [max(content["objects"], key=lambda entry: entry["visible_fraction"])]
    (capture / "truth.json").write_text(json.dumps(content))
    partly_masked = Config.model_validate({"perceive": {"min_explained": 0.0}})
    ((row,),) = next(bench_placement(tmp_path, partly_masked, (WAY,))).values()
    assert row.completion == "replay"
    assert 0.0 < row.position_error_m < 0.01
    assert abs(row.height_error_m) <= row.position_error_m
    assert row.size_error < 0.15
    assert 0.0 < row.position_std_m < 0.01
    assert np.isnan(row.heading_error_rad) == (row.symmetry == 0)


def test_a_folder_without_truth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="tableverse synth"):
        next(bench_placement(tmp_path, Config(), (WAY,)))
