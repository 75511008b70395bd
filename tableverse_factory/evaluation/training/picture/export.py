"""Export of the network of pictures to ONNX: weights in half precision, which the runtime widens when it loads them."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np

from tableverse_factory.core.errors import ModelError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.evaluation.training.checkpoint import WEIGHTS, read_weights
from tableverse_factory.evaluation.training.picture.network import make_network
from tableverse_factory.models.local.device import import_torch
from tableverse_factory.models.picture.net import INPUTS, MAPS, VECTORS, PictureNet

OPSET = 17
TRACED = (288, 384)  # height and width of the pictures that trace the graph, which takes any multiple of 16
CHECKED = (64, 96)  # of those that compare it with torch
LEAST_WEIGHTS = 64  # smaller arrays keep single precision: they are constants of the graph
TOLERANCE = 0.01  # largest allowed difference from the network in torch, relative to the largest value of each output


def export_network(folder: Path, path: Path) -> float:
    """Write the averaged weights of a training's folder as an ONNX file; return its difference from torch on noise.

    It is relative to the largest value of each output; beyond `TOLERANCE` a `ModelError` is raised.
    """
    onnx: Any = import_extra("onnx", "training", "training")
    network = make_network(0)
    read_weights(folder / WEIGHTS, network)
    partial = path.with_suffix(".partial")
    _trace(network.eval(), partial)
    model = onnx.load(partial)
    casts = []
    for weights in model.graph.initializer:
        values = onnx.numpy_helper.to_array(weights)
        if values.dtype == np.float32 and values.size >= LEAST_WEIGHTS:
            name = weights.name
            weights.CopyFrom(onnx.numpy_helper.from_array(values.astype(np.float16), f"{name}_half"))
            casts.append(onnx.helper.make_node("Cast", [f"{name}_half"], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *model.graph.node]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.checker.check_model(model)
    data = model.SerializeToString(deterministic=True)
    partial.write_bytes(data)
    difference = _measure_difference(network, PictureNet(partial, data))
    if not difference <= TOLERANCE:
        partial.unlink()
        raise ModelError(f"the ONNX file differs from the network by {difference:.1e} of its largest output")
    partial.rename(path)
    return difference


def _trace(network: Any, path: Path) -> None:
    torch = import_torch()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter that needs no further package is called old
        torch.onnx.export(
            network,
            tuple(torch.zeros(1, channels, *TRACED) for channels in INPUTS.values()),
            path,
            dynamo=False,
            opset_version=OPSET,
            input_names=[*INPUTS],
            output_names=[*MAPS, *VECTORS],
            dynamic_axes={name: {2: "height", 3: "width"} for name in (*INPUTS, *MAPS)},
        )


def _measure_difference(network: Any, net: PictureNet) -> float:
    torch = import_torch()
    height, width = CHECKED
    rng = np.random.default_rng(0)
    ys, xs = np.mgrid[:height, :width] / width - 0.5
    rays = np.stack([xs, ys, np.ones_like(xs)])
    inputs = {
        "image": rng.random((3, height, width), dtype=np.float32),
        "rays": (rays / np.linalg.norm(rays, axis=0)).astype(np.float32),
        "depth": rng.random((1, height, width), dtype=np.float32),
    }
    with torch.inference_mode():
        outputs = network(*(torch.tensor(inputs[name][None]) for name in INPUTS))
    wanted = {name: each[0].numpy() for name, each in zip((*MAPS, *VECTORS), outputs, strict=True)}
    found = net(inputs)
    return max(float(np.abs(found[k] - each).max() / max(np.abs(each).max(), 1e-6)) for k, each in wanted.items())
