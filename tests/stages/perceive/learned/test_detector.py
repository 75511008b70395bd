"""The `learned` detector: what it is asked, what becomes of its votes, and what is said of files that are no net."""

from pathlib import Path

import numpy as np
import pytest

from schemas.config import Config
from tableverse_factory.core.config import load_config
from tableverse_factory.core.errors import ConfigError, ModelAccessError, ModelError
from tableverse_factory.run_record import collect_external_inputs
from tableverse_factory.stages.perceive.learned.mean_shift import cluster_votes
from tableverse_factory.stages.perceive.learned.onnx import SegmentationNet

onnx = pytest.importorskip("onnx")
pytest.importorskip("onnxruntime")


def _config(path: Path) -> Config:
    return Config.model_validate({"perceive": {"detector": "learned", "detector_weights": str(path)}})


def _votes(rng: np.random.Generator, *middles: tuple[float, float, float]) -> np.ndarray:
    return np.concatenate([np.array(middle) + rng.normal(0.0, 0.006, (200, 3)) for middle in middles])


def test_votes_about_two_middles_are_two_things_whatever_their_order() -> None:
    rng = np.random.default_rng(0)
    votes = _votes(rng, (0.0, 0.0, 0.05), (0.0, 0.0, 0.12))
    found = cluster_votes(votes, 24)
    assert sorted(set(found)) == [0, 1]
    assert len(set(found[:200])) == len(set(found[200:])) == 1
    order = rng.permutation(len(votes))
    assert np.array_equal(cluster_votes(votes[order], 24), found[order])


def test_votes_about_one_middle_are_one_thing_and_few_are_none() -> None:
    rng = np.random.default_rng(1)
    votes = np.vstack([_votes(rng, (0.3, 0.1, 0.02)), _votes(rng, (1.0, 1.0, 0.1))[:10]])
    found = cluster_votes(votes, 24)
    assert (found[:200] == 0).mean() > 0.98
    assert (found[200:] == -1).all()
    assert len(cluster_votes(np.zeros((0, 3)), 24)) == 0


def _file(path: Path, told: str, channels: int = 7, outputs: int = 4, half: bool = True) -> Path:
    """A net of one convolution."""
    kernel = onnx.numpy_helper.from_array(np.zeros((outputs, channels, 1, 1), dtype=np.float32), "kernel")
    value = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        [onnx.helper.make_node("Conv", ["input", "kernel"], ["output"], strides=[2 if half else 1] * 2)],
        "one",
        [value("input", onnx.TensorProto.FLOAT, ["b", channels, "h", "w"])],
        [value("output", onnx.TensorProto.FLOAT, ["b", outputs, "hh", "ww"])],
        [kernel],
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=9)
    onnx.helper.set_model_props(model, {"format": told})
    path.write_bytes(model.SerializeToString())
    return path


def test_what_is_no_net_is_said_in_one_line(tmp_path: Path) -> None:
    text = tmp_path / "text.onnx"
    text.write_text("no net\n" * 40)
    cases = {
        tmp_path / "missing.onnx": "is no file",
        tmp_path: "is no file",
        text: "is no ONNX file",
        _file(tmp_path / "foreign.onnx", "something-else"): "another net",
        _file(tmp_path / "inputs.onnx", "tableverse-segmenter-1", channels=3): "another net",
    }
    for path, words in cases.items():
        with pytest.raises(ModelAccessError, match=words) as told:
            SegmentationNet(path)
        assert "\n" not in str(told.value)
        assert "perceive.detector_weights" in str(told.value)


def test_a_net_may_not_read_weights_from_other_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model = onnx.load(_file(tmp_path / "net.onnx", "tableverse-segmenter-1"))
    (tmp_path / "beside.bin").write_bytes(bytes(4 * 7 * 4))
    kernel = model.graph.initializer[0]
    kernel.ClearField("raw_data")
    kernel.data_location = onnx.TensorProto.EXTERNAL
    entry = kernel.external_data.add()
    entry.key, entry.value = "location", "beside.bin"
    (tmp_path / "net.onnx").write_bytes(model.SerializeToString())
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelAccessError, match="is no ONNX file"):
        SegmentationNet(tmp_path / "net.onnx")


@pytest.mark.parametrize(("outputs", "half"), [(5, True), (4, False)])
def test_an_answer_of_another_shape_is_an_error(tmp_path: Path, outputs: int, half: bool) -> None:
    net = SegmentationNet(_file(tmp_path / "net.onnx", "tableverse-segmenter-1", outputs=outputs, half=half))
    with pytest.raises(ModelError, match="is wanted"):
        net(np.zeros((7, 32, 32), dtype=np.float32))


def test_learned_without_weights_is_refused_by_the_configuration() -> None:
    with pytest.raises(ConfigError, match=r"perceive\.detector_weights"):
        load_config(None, ["perceive.detector=learned"])


def test_the_bytes_of_the_net_are_part_of_the_run(tmp_path: Path) -> None:
    path = _file(tmp_path / "net.onnx", "tableverse-segmenter-1")
    first = collect_external_inputs(_config(path))["detector"]
    path.write_bytes(path.read_bytes() + b"\x00")
    second = collect_external_inputs(_config(path))["detector"]
    assert first["sha256"] != second["sha256"]
    assert first["onnxruntime"] == second["onnxruntime"] != "none"
