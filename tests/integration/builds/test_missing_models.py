"""A build whose models cannot be loaded ends before anything is written or started, and says what is wrong."""

from pathlib import Path

import pytest
from PIL import Image

from schemas.config import Config
from tableverse_factory.core.errors import WeightsError
from tableverse_factory.models.picture.net import SHIPPED
from tableverse_factory.sources.manifest import make_manifest, write_manifest
from tests.helpers.builds import Silent
from tests.helpers.depth_weights import save_tiny_depth
from tests.helpers.weights_hub import Model, weights_hub
from workers.run import BuildRequest, run_build


@pytest.fixture
def refuse(tmp_path, monkeypatch):
    """Build one picture on Ray, which has to be refused; returns the message."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "pictures").mkdir()
    Image.new("RGB", (160, 120)).save(tmp_path / "pictures" / "a.png")
    write_manifest(tmp_path / "m.parquet", make_manifest([str(tmp_path / "pictures")], Config().observe).rows)

    def build(**sections):
        config = Config.model_validate({"models": {"device": "cpu"}, **sections})
        request = BuildRequest(tmp_path / "m.parquet", tmp_path / "out", config, tmp_path / "cache", "ray", workers=1)
        with pytest.raises(WeightsError) as told:
            run_build(request, Silent())
        assert told.value.topic == "weights"
        assert not (tmp_path / "out").exists()
        return str(told.value)

    return build


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("section", "key"), [("observe", "depth_weights"), ("perceive", "detector_weights")], ids=["depth", "detector"]
)
def test_a_net_that_is_missing_or_damaged(refuse, section, key):
    assert "'none.onnx' is no file" in refuse(**{section: {key: "none.onnx"}})
    Path("cut.onnx").write_bytes(SHIPPED.read_bytes()[:100_000])
    told = refuse(**{section: {key: "cut.onnx"}})
    assert f"{section}.{key}" in told
    assert "is no ONNX file: Failed to load model" in told
    assert not told.endswith(".")


@pytest.mark.heavy
def test_a_folder_of_weights_that_is_missing_empty_or_damaged(refuse, tmp_path):
    pytest.importorskip("transformers", reason="the extra `models`")
    observe = {"depth": "depth_anything_2", "depth_weights": str(tmp_path / "weights")}
    assert "no such folder here" in refuse(observe=observe)
    (tmp_path / "weights").mkdir()
    assert "no *.safetensors in this folder" in refuse(observe=observe)
    save_tiny_depth(tmp_path / "weights")
    (file,) = (tmp_path / "weights").glob("*.safetensors")
    file.write_bytes(file.read_bytes()[:-100])
    assert f"{file.name} is damaged" in refuse(observe=observe)


@pytest.mark.heavy
def test_weights_of_the_hub_that_are_out_of_reach(refuse, tmp_path, monkeypatch):
    pytest.importorskip("transformers", reason="the extra `models`")
    observe = {"depth": "depth_anything_2", "depth_weights": "someone/tiny-depth"}
    save_tiny_depth(tmp_path / "weights")
    with weights_hub(monkeypatch, tmp_path / "hub") as hub:
        assert "the hub knows no such model" in refuse(observe=observe)
        commit = hub.models.setdefault("someone/tiny-depth", Model()).commit(tmp_path / "weights")
        hub.gated.add("someone/tiny-depth")
        observe["depth_weights"] = f"someone/tiny-depth@{commit}"
        assert "is gated" in refuse(observe=observe)


def test_a_package_that_is_missing(refuse):
    pytest.importorskip("torch", reason="the extra `models`")
    assert "MoGe-2 is not installed; pip install" in refuse(observe={"depth": "moge_2"})
