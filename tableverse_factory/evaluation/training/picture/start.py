"""Weights that a training starts from: those of another training, or those of an exported network."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.evaluation.training.checkpoint import read_weights
from tableverse_factory.evaluation.training.picture.network import Convolution
from tableverse_factory.evaluation.training.picture.samples import Sample
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

HALF = "_half"  # ends the names of weights in half precision


def read_start(path: Path, network: Any) -> bool:
    """Load weights that `write_weights` wrote, or those of an `.onnx` file; return whether its norms lack statistics.

    An exported network has none: they are part of its convolutions. `measure_norms` provides new ones.
    """
    if path.suffix != ".onnx":
        read_weights(path, network)
        return False
    onnx: Any = import_extra("onnx", "training", "training")
    try:
        graph = onnx.load(path).graph
        _load_graph(graph, {each.name: onnx.numpy_helper.to_array(each) for each in graph.initializer}, network)
    except Exception as error:  # protobuf's errors have no common base with torch's
        raise InputError(f"{path} holds no weights of this network: {error}") from error
    return True


def _load_graph(graph: Any, arrays: dict[str, np.ndarray], network: Any) -> None:
    """Load the arrays that nodes named after their modules refer to; each convolution's bias goes to its norm."""
    arrays = {name.removesuffix(HALF): each.astype(np.float32) for name, each in arrays.items()}
    state = network.state_dict()
    found = {name: each for name, each in arrays.items() if name in state}
    for node in graph.node:
        module, own = _find_module(node.name), [arrays[name] for name in node.input[1:] if name in arrays]
        if node.op_type == "Conv" and f"{module}.weight" not in found:
            length = np.sqrt(np.square(own[0]).sum(axis=(1, 2, 3)))
            found[f"{module}.weight"] = own[0] / np.maximum(length, 1e-12)[:, None, None, None]
            norm = module.removesuffix("convolve") + "norm"
            found |= {f"{norm}.weight": length, f"{norm}.bias": own[1]}
        elif node.op_type == "MatMul" and own:
            found[f"{module}.weight"] = own[0].T
    for name in state:  # of a norm that changes nothing but the length of its filters
        if name.endswith(("running_mean", "num_batches_tracked")):
            found[name] = np.zeros(tuple(state[name].shape), state[name].numpy().dtype)
        elif name.endswith("running_var"):
            found[name] = np.full(tuple(state[name].shape), 1.0 - network.full.norm.eps, np.float32)
    network.load_state_dict({name: torch.from_numpy(np.array(each)) for name, each in found.items()})


def _find_module(node: str) -> str:
    """Find the module of a node named `/levels.0/levels.0.1/first/convolve/Conv`: `levels.0.1.first.convolve`."""
    parts = node.strip("/").split("/")[:-1]
    followed = zip(parts, [*parts[1:], ""][: len(parts)], strict=True)
    return ".".join(part for part, after in followed if not after.startswith(f"{part}."))


def measure_norms(network: Any, samples: Iterable[Sample], device: str) -> None:
    """Give every norm the statistics of `samples`, and change its scale so that the network computes what it did.

    In training a norm uses the statistics of a batch: without this the first step would compute something else.
    """
    layers = [module for module in network.modules() if isinstance(module, Convolution)]
    moments: dict[Any, list[Tensor]] = {layer.convolve: [] for layer in layers}

    def add_moments(module: Any, _: Any, output: Tensor) -> None:
        values = output.float()
        moments[module].append(torch.stack([values.mean((0, 2, 3)), values.square().mean((0, 2, 3))]))

    hooks = [layer.convolve.register_forward_hook(add_moments) for layer in layers]
    network.eval()
    with torch.no_grad(), torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
        for sample in samples:
            network(sample.image.contiguous(memory_format=torch.channels_last), sample.rays, sample.sensed)
        for layer in layers:
            norm = layer.norm
            gain = norm.weight / (norm.running_var + norm.eps).sqrt()
            offset = norm.bias - gain * norm.running_mean
            mean, square = torch.stack(moments[layer.convolve]).mean(0)
            norm.running_mean.copy_(mean)
            norm.running_var.copy_((square - mean.square()).clamp(min=0))
            norm.weight.copy_(gain * (norm.running_var + norm.eps).sqrt())
            norm.bias.copy_(offset + gain * mean)
    for hook in hooks:
        hook.remove()
    network.train()
