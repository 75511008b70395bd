"""An exported network becomes the start of a training: the same weights, and norms that do what they did."""

import copy
from pathlib import Path
from typing import Any

import pytest

torch = pytest.importorskip("torch", reason="the extra `models` is not installed")
onnx = pytest.importorskip("onnx", reason="the extra `training` is not installed")
from tableverse_factory.core.errors import InputError  # noqa: E402
from tableverse_factory.evaluation.training.checkpoint import WEIGHTS  # noqa: E402
from tableverse_factory.evaluation.training.picture.network import Convolution, make_network  # noqa: E402
from tableverse_factory.evaluation.training.picture.samples import Sample  # noqa: E402
from tableverse_factory.evaluation.training.picture.start import measure_norms, read_start  # noqa: E402
from tableverse_factory.models.picture.net import MAPS, SHIPPED  # noqa: E402

pytestmark = pytest.mark.heavy


def make_noise(seed: int) -> Sample:
    """Pictures of noise with plausible rays, and nothing to learn."""
    generator = torch.Generator().manual_seed(seed)
    ys, xs = torch.meshgrid(torch.linspace(-0.4, 0.4, 32), torch.linspace(-0.5, 0.5, 48), indexing="ij")
    rays = torch.nn.functional.normalize(torch.stack([xs, ys, torch.ones_like(xs)]), dim=0)
    image = torch.rand(6, 3, 32, 48, generator=generator)
    depth = torch.rand(6, 1, 32, 48, generator=generator)
    nothing = torch.zeros(6, 32, 48)
    flat = torch.zeros(6)
    return Sample(
        image, rays.repeat(6, 1, 1, 1), depth, nothing.long(), nothing, nothing, torch.zeros(6, 4), flat, flat
    )


def run(network: Any, sample: Sample, train: bool) -> list[Any]:
    """Outputs of a copy of the network, which batches change."""
    with torch.no_grad():
        return list(copy.deepcopy(network).train(train)(sample.image, sample.rays, sample.sensed))


def test_the_network_of_the_package_comes_back_byte_by_byte_and_goes_on_where_it_stopped() -> None:
    network = make_network(0)
    assert read_start(SHIPPED, network), "its norms lack statistics"
    exported = {each.name: onnx.numpy_helper.to_array(each) for each in onnx.load(SHIPPED).graph.initializer}
    halves = {each.tobytes() for each in exported.values()}
    layers = [module for module in network.modules() if isinstance(module, Convolution)]
    assert len(layers) > 30
    for layer in layers:
        folded = (
            layer.convolve.weight
            * (layer.norm.weight / (layer.norm.running_var + layer.norm.eps).sqrt())[:, None, None, None]
        )
        assert folded.detach().half().numpy().tobytes() in halves
    assert torch.equal(network.attention[0].mix.bias.half(), torch.tensor(exported["attention.0.mix.bias_half"]))
    sample = make_noise(9)
    before, unmeasured = run(network, sample, train=False), run(network, sample, train=True)
    measure_norms(network, (make_noise(seed) for seed in range(4)), "cpu")
    after, training = run(network, sample, train=False), run(network, sample, train=True)
    for index, name in enumerate(MAPS):
        largest = float(before[index].abs().max())
        assert torch.allclose(after[index], before[index], atol=1e-3 * largest), name
    assert (training[0] - before[0]).abs().mean() < 0.3 * (unmeasured[0] - before[0]).abs().mean()


def test_files_that_hold_another_network_are_refused(tmp_path: Path) -> None:
    other = tmp_path / "other.onnx"
    other.write_bytes(b"no network")
    with pytest.raises(InputError, match="holds no weights of this network"):
        read_start(other, make_network(0))
    model = onnx.load(SHIPPED)
    del model.graph.initializer[3]
    onnx.save(model, other)
    with pytest.raises(InputError, match="holds no weights of this network"):
        read_start(other, make_network(0))
    (tmp_path / WEIGHTS).write_bytes(b"nothing")
    with pytest.raises(InputError, match="holds no weights of this network"):
        read_start(tmp_path / WEIGHTS, make_network(0))
