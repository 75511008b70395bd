"""The recipe for CPUs builds pictures with its own models, tiny and with random weights, from a hub of this machine."""

import json

import pytest
from PIL import Image

from tableverse_factory import open_dataset
from tableverse_factory.core.config import load_config
from tableverse_factory.models.local.weight_files import find_models
from tableverse_factory.sources.manifest import make_manifest, write_manifest
from tests.helpers.builds import Silent, scenes
from tests.helpers.captures_on_disk import write_picture
from tests.helpers.depth_weights import save_tiny_depth
from tests.helpers.grounding_dino_models import save_tiny_dino
from tests.helpers.paths import ROOT
from tests.helpers.sam_models import save_tiny
from tests.helpers.tabletop_views import Box, look
from tests.helpers.weights_hub import Model, weights_hub
from workers.run import BuildRequest, run_build

RECIPE = ROOT / "recipes" / "pictures-cpu.yaml"
SAVERS = {
    "depth-anything-v2-small": lambda folder: save_tiny_depth(folder, max_depth=2),
    "grounding-dino-tiny": save_tiny_dino,
    "sam2.1-tiny": lambda folder: save_tiny("sam2", folder),
}


def write_sensor_capture(folder):
    """A box on a table with a sensor's depth, which no depth model replaces."""
    observation, _ = look([Box(0.0, 0.0, (0.15, 0.12, 0.12))])
    folder.mkdir(parents=True)
    Image.fromarray(observation.color).save(folder / "color.png")
    Image.fromarray((observation.depth * 1000).round().astype("uint16")).save(folder / "depth.png")
    camera = {name: getattr(observation.camera, name) for name in ("fx", "fy", "cx", "cy", "width", "height")}
    (folder / "camera.json").write_text(json.dumps({**camera, "depth_scale": 0.001}))


@pytest.mark.slow
def test_pictures_and_captures_go_through_the_models_of_the_recipe(tmp_path, monkeypatch):
    write_picture(tmp_path / "photos" / "noise.png", 0, (120, 160))
    write_sensor_capture(tmp_path / "photos" / "capture")
    config = load_config(RECIPE)
    write_manifest(tmp_path / "images.parquet", make_manifest([str(tmp_path / "photos")], config.observe).rows)
    models, _ = find_models(config)
    with weights_hub(monkeypatch, tmp_path / "hub") as hub:
        for model in models:
            SAVERS[model.name](tmp_path / model.name)
            own = hub.models[model.repository] = Model()
            own.commits[model.revision] = own.commits[own.commit(tmp_path / model.name)]

        request = BuildRequest(tmp_path / "images.parquet", tmp_path / "out", config, tmp_path / "cache")
        run_build(request, Silent())
    for model in models:
        assert f"/{model.repository}/resolve/{model.revision}/model.safetensors" in hub.asked
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert [run[part]["weights"] for part in ("depth", "detector", "segmenter")] == [model.weights for model in models]
    rows = {row["kind"]: row for row in scenes(tmp_path / "out")}
    assert {kind: row["status"] for kind, row in rows.items()} == {"capture": "done", "image": "done"}
    assert {kind: row["scale_source"] for kind, row in rows.items()} == {"capture": "sensor", "image": "estimated"}
    assert {row["perception"] for row in rows.values()} == {"grounding_dino"}
    dataset = open_dataset(tmp_path / "out")
    labels = {item["label"] for row in rows.values() for item in dataset.scene(row["scene_id"]).meta["objects"]}
    assert labels
    assert labels <= {*config.perceive.vocabulary}
