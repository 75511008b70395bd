"""The net of bare pictures is loaded whole or not at all: one byte, another net and another's file are refused."""

import hashlib
import shutil
from pathlib import Path

import numpy as np
import pytest

from tableverse_factory.core.errors import ModelAccessError, ModelError
from tableverse_factory.models.picture import net as picture_net
from tableverse_factory.models.picture.net import DIGEST, INPUTS, MAPS, MAX_BYTES, SHIPPED, VECTORS, PictureNet

onnx = pytest.importorskip("onnx")

load = picture_net.load_picture_net.__wrapped__  # what is refused must not be remembered


@pytest.fixture
def copy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """The shipped files where they can be damaged."""
    net, digest = (Path(shutil.copy(path, tmp_path)) for path in (SHIPPED, DIGEST))
    monkeypatch.setattr(picture_net, "SHIPPED", net)
    monkeypatch.setattr(picture_net, "DIGEST", digest)
    return net, digest


def write_net(path: Path, inputs: dict[str, int], outputs: dict[str, int], *, value: float = 0.0) -> Path:
    """A net that answers constants, as maps of 32 x 32 or as vectors."""
    declare, nodes, constants = onnx.helper.make_tensor_value_info, [], []
    for name, count in outputs.items():
        shape = (1, count) if name in VECTORS else (1, count, 32, 32)
        constants.append(onnx.numpy_helper.from_array(np.full(shape, value, np.float32), f"{name}_constant"))
        nodes.append(onnx.helper.make_node("Identity", [f"{name}_constant"], [name]))
    graph = onnx.helper.make_graph(
        nodes,
        "constants",
        [declare(name, onnx.TensorProto.FLOAT, [1, count, "h", "w"]) for name, count in inputs.items()],
        [
            declare(name, onnx.TensorProto.FLOAT, [1, count] if name in VECTORS else [1, count, 32, 32])
            for name, count in outputs.items()
        ],
        constants,
    )
    model = onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 17)], ir_version=9)
    path.write_bytes(model.SerializeToString())
    return path


def ask(net: PictureNet, height: int, width: int) -> dict[str, np.ndarray]:
    return net({name: np.zeros((count, height, width), np.float32) for name, count in INPUTS.items()})


def test_the_digest_is_that_of_the_net() -> None:
    assert hashlib.sha256(SHIPPED.read_bytes()).hexdigest() == DIGEST.read_text().strip()
    assert SHIPPED.stat().st_size <= 40_000_000


@pytest.mark.heavy
def test_the_shipped_files_are_loaded_from_where_they_are(copy: tuple[Path, Path]) -> None:
    assert isinstance(load(""), PictureNet)


@pytest.mark.parametrize("at", [0, 0.5, 1])
def test_one_byte_that_differs_is_refused(copy: tuple[Path, Path], at: float) -> None:
    data = bytearray(copy[0].read_bytes())
    data[int(at * (len(data) - 1))] ^= 1
    copy[0].write_bytes(data)
    with pytest.raises(ModelAccessError, match="is damaged: its SHA-256 begins with") as refused:
        load("")
    assert "install the package again" in str(refused.value)


def test_a_net_cut_short_is_refused(copy: tuple[Path, Path]) -> None:
    copy[0].write_bytes(copy[0].read_bytes()[:-1])
    with pytest.raises(ModelAccessError, match="is damaged"):
        load("")


@pytest.mark.parametrize("missing", [0, 1], ids=["net", "digest"])
def test_a_missing_file_is_said(copy: tuple[Path, Path], missing: int) -> None:
    copy[missing].unlink()
    with pytest.raises(ModelAccessError, match=f"missing: .*{copy[missing].name}.*install the package again"):
        load("")


def test_another_net_in_its_place_is_refused(copy: tuple[Path, Path]) -> None:
    write_net(copy[0], INPUTS, {**MAPS, **VECTORS})
    with pytest.raises(ModelAccessError, match="is damaged"):
        load("")


def test_what_a_user_names_has_to_be_such_a_net(tmp_path: Path) -> None:
    text, large = tmp_path / "text.onnx", tmp_path / "large.onnx"
    text.write_text("no net\n" * 40)
    with large.open("wb") as file:
        file.truncate(MAX_BYTES + 1)
    cases = {
        tmp_path / "missing.onnx": "is no file here",
        tmp_path: "is no file here",
        large: f"has {MAX_BYTES + 1} bytes, and a net at most {MAX_BYTES}",
        text: "is no ONNX file",
        write_net(tmp_path / "inputs.onnx", {"image": 3}, {**MAPS, **VECTORS}): "another net: it takes image and",
        write_net(tmp_path / "outputs.onnx", INPUTS, MAPS): "another net.*table.* is wanted",
    }
    for path, words in cases.items():
        with pytest.raises(ModelAccessError, match=words) as refused:
            load(str(path))
        assert "\n" not in str(refused.value)
        assert str(path) in str(refused.value)


def test_a_user_s_net_answers_without_the_first_axis(tmp_path: Path) -> None:
    found = ask(load(str(write_net(tmp_path / "own.onnx", INPUTS, {**MAPS, **VECTORS}, value=0.25))), 32, 32)
    assert {name: array.shape for name, array in found.items()} == {
        **{name: (count, 32, 32) for name, count in MAPS.items()},
        **{name: (count,) for name, count in VECTORS.items()},
    }
    assert all((array == 0.25).all() and array.dtype == np.float32 for array in found.values())


def test_answers_of_another_size_or_that_are_no_numbers_are_refused(tmp_path: Path) -> None:
    other = load(str(write_net(tmp_path / "own.onnx", INPUTS, {**MAPS, **VECTORS})))
    with pytest.raises(ModelError, match=r"answers label of shape \(1, 3, 32, 32\)"):
        ask(other, 64, 32)
    nothing = load(str(write_net(tmp_path / "nan.onnx", INPUTS, {**MAPS, **VECTORS}, value=np.nan)))
    with pytest.raises(ModelError, match="finite"):
        ask(nothing, 32, 32)


def test_a_user_s_net_reads_no_weights_from_other_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_net(tmp_path / "net.onnx", INPUTS, MAPS | VECTORS)
    assert isinstance(load(str(path)), PictureNet)
    model = onnx.load(path)
    constant = model.graph.initializer[0]
    (tmp_path / "beside.bin").write_bytes(constant.raw_data)
    constant.ClearField("raw_data")
    constant.data_location = onnx.TensorProto.EXTERNAL
    entry = constant.external_data.add()
    entry.key, entry.value = "location", "beside.bin"
    path.write_bytes(model.SerializeToString())
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ModelAccessError, match="is no ONNX file"):
        load(str(path))
