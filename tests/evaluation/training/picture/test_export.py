"""The ONNX file says what the network says, and has the same bytes again."""

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="the extra `models` is not installed")
onnx = pytest.importorskip("onnx", reason="the extra `training` is not installed")
from tableverse_factory.core.errors import ModelError  # noqa: E402
from tableverse_factory.evaluation.training.checkpoint import WEIGHTS, read_weights, write_weights  # noqa: E402
from tableverse_factory.evaluation.training.picture import export as export_module  # noqa: E402
from tableverse_factory.evaluation.training.picture.export import export_network  # noqa: E402
from tableverse_factory.evaluation.training.picture.network import make_network  # noqa: E402
from tableverse_factory.models.picture.net import INPUTS, MAPS, VECTORS, load_picture_net  # noqa: E402

pytestmark = [pytest.mark.heavy, pytest.mark.usefixtures("thin")]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Weights as after a training: normalisation and residual branches do something."""
    network, generator = make_network(1), torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, tensor in network.state_dict().items():
            if name.endswith(("running_mean", "running_var", "norm.weight")):
                tensor.copy_(torch.rand(tensor.shape, generator=generator) + 0.5)
    write_weights(network, tmp_path)
    return tmp_path


def test_the_file_says_what_the_network_says_at_any_size_and_has_the_same_bytes_again(folder: Path) -> None:
    path = folder / "picture.onnx"
    assert 0 < export_network(folder, path) < 0.005
    first = path.read_bytes()
    export_network(folder, path)
    assert path.read_bytes() == first
    network = make_network(0).eval()
    read_weights(folder / WEIGHTS, network)
    net = load_picture_net(str(path))
    for height, width in ((32, 64), (96, 48)):
        ys, xs = np.mgrid[:height, :width] / width - 0.5
        rays = np.stack([xs, ys, np.ones_like(xs)])
        rays /= np.linalg.norm(rays, axis=0)
        rng = np.random.default_rng(height)
        inputs = {"image": rng.random((3, height, width)), "rays": rays, "depth": np.zeros((1, height, width))}
        inputs = {name: inputs[name].astype(np.float32) for name in INPUTS}
        found = net(inputs)
        with torch.inference_mode():
            wanted = network(*(torch.tensor(inputs[name][None]) for name in INPUTS))
        assert found.keys() == {*MAPS, *VECTORS}
        for name, each in zip((*MAPS, *VECTORS), wanted, strict=True):
            assert np.allclose(found[name], each[0].numpy(), atol=0.005 * float(each.abs().max())), name


def test_weights_are_stored_in_half_precision(folder: Path) -> None:
    export_network(folder, folder / "picture.onnx")
    model = onnx.load(folder / "picture.onnx")
    sizes: dict[int, int] = {}
    for each in model.graph.initializer:
        sizes[each.data_type] = sizes.get(each.data_type, 0) + int(np.prod(each.dims))
    assert sizes[onnx.TensorProto.FLOAT16] > 20 * sizes.get(onnx.TensorProto.FLOAT, 0)
    count = sum(tensor.numel() for tensor in make_network(0).parameters())
    assert (folder / "picture.onnx").stat().st_size < 2 * count + 200_000


def test_a_file_that_says_something_else_is_not_written(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(export_module, "TOLERANCE", 1e-9)
    with pytest.raises(ModelError, match="differs from the network"):
        export_network(folder, folder / "picture.onnx")
    assert [path.name for path in folder.glob("picture.*")] == []
