"""A build with weights of the hub, on real stages: it goes on with what it began with, wherever the hub has gone."""

import json
import shutil

import pytest

from schemas.config import Config
from tableverse_factory.sources.manifest import make_manifest, write_manifest
from tests.helpers.builds import Silent, scenes
from tests.helpers.captures_on_disk import write_picture
from tests.helpers.depth_weights import save_tiny_depth
from tests.helpers.weights_hub import Model, weights_hub
from workers.run import BuildRequest, run_build

NAME = "someone/tiny-depth"


@pytest.mark.slow
def test_a_build_goes_on_with_the_weights_that_it_began_with(tmp_path, monkeypatch):
    for k in range(2):
        write_picture(tmp_path / "pictures" / f"{k}.png", k, (120, 160))
        save_tiny_depth(tmp_path / f"weights{k}", seed=k)
    rows = make_manifest([str(tmp_path / "pictures")], Config().observe).rows
    write_manifest(tmp_path / "images.parquet", rows)
    observe = {"depth": "depth_anything_2", "depth_weights": NAME, "focal_px": 150.0}
    config = Config.model_validate({"observe": observe, "models": {"device": "cpu"}})

    def build(limit):
        request = BuildRequest(tmp_path / "images.parquet", tmp_path / "out", config, tmp_path / "cache", limit=limit)
        run_build(request, Silent())
        return json.loads((tmp_path / "out" / "run.json").read_text())

    with weights_hub(monkeypatch, tmp_path / "hub") as hub:
        model = hub.models[NAME] = Model()
        began = model.commit(tmp_path / "weights0")
        first = build(limit=1)
        assert first["depth"]["weights"] == f"{NAME}@{began}"
        assert f"/{NAME}/resolve/{began}/model.safetensors" in hub.asked
        model.commit(tmp_path / "weights1")
        shutil.rmtree(tmp_path / "hub")  # as on another machine
        hub.asked.clear()
        assert build(limit=None) == first
        assert f"/{NAME}/resolve/{began}/model.safetensors" in hub.asked
        assert not [path for path in hub.asked if model.refs["main"] in path or path.startswith("/api/models")]
    assert {row["status"] for row in scenes(tmp_path / "out")} <= {"done", "dropped"}
