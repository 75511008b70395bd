"""ONNX file of the trained network, from the same list of layers that torch runs."""

from pathlib import Path
from typing import Any

import numpy as np

from tableverse_factory.core.errors import ModelError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.evaluation.training.network import ConvLayer, fold_batch_norm, forward, list_layers
from tableverse_factory.models.local.device import import_torch
from tableverse_factory.stages.perceive.learned.net_format import CHANNELS, FORMAT, OUTPUTS
from tableverse_factory.stages.perceive.learned.onnx import SegmentationNet

OPSET = 17
IR_VERSION = 9
TOLERANCE = 1e-3  # largest allowed difference from float32 arithmetic, relative to the largest output


def write_onnx(network: Any, path: Path) -> float:
    """Write the network; return the largest difference between onnxruntime and torch on noise.

    It is relative to the largest output; beyond `TOLERANCE` a `ModelError` is raised. Without onnx: `no_extra`.
    """
    onnx: Any = import_extra("onnx", "training", "models")
    weights = fold_batch_norm(network)
    nodes: list[Any] = []
    constants = [onnx.numpy_helper.from_array(np.array([1, 1, 2, 2], dtype=np.float32), "twice")]
    for layer in list_layers():
        kernel, bias = weights[layer.name]
        constants += [
            onnx.numpy_helper.from_array(kernel, f"{layer.name}.kernel"),
            onnx.numpy_helper.from_array(bias, f"{layer.name}.bias"),
        ]
        nodes += _make_nodes(onnx, layer)
    value = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        nodes,
        "segmenter",
        [value("input", onnx.TensorProto.FLOAT, ["batch", CHANNELS, "height", "width"])],
        [value("output", onnx.TensorProto.FLOAT, ["batch", OUTPUTS, "half_height", "half_width"])],
        constants,
    )
    model = onnx.helper.make_model(
        graph, opset_imports=[onnx.helper.make_opsetid("", OPSET)], ir_version=IR_VERSION, producer_name="tableverse"
    )
    onnx.helper.set_model_props(model, {"format": FORMAT})
    onnx.checker.check_model(model)
    partial = path.with_suffix(".partial")
    partial.write_bytes(model.SerializeToString(deterministic=True))
    difference = _measure_difference(network, SegmentationNet(partial))
    if difference > TOLERANCE:
        partial.unlink()
        raise ModelError(f"the ONNX file differs from the network by {difference:.1e} of its largest output")
    partial.rename(path)
    return difference


def _make_nodes(onnx: Any, layer: ConvLayer) -> list[Any]:
    """Make the operators of one layer; the last one writes the result of that name."""
    make = onnx.helper.make_node
    raw = layer.name if layer.plain else f"{layer.name}.raw"
    convolved = f"{layer.name}.convolved" if layer.onto else raw
    nodes = [
        make(
            "Conv",
            [layer.source, f"{layer.name}.kernel", f"{layer.name}.bias"],
            [convolved],
            kernel_shape=[layer.kernel] * 2,
            strides=[layer.stride] * 2,
            dilations=[layer.dilation] * 2,
            pads=[layer.padding] * 4,
        )
    ]
    if layer.onto:
        larger = f"{layer.name}.larger"
        nearest = {"mode": "nearest", "coordinate_transformation_mode": "asymmetric", "nearest_mode": "floor"}
        nodes.append(make("Resize", [layer.onto, "", "twice"], [larger], **nearest))
        nodes.append(make("Add", [convolved, larger], [raw]))
    if not layer.plain:
        nodes.append(make("Relu", [raw], [layer.name]))
    return nodes


def _measure_difference(network: Any, net: SegmentationNet) -> float:
    torch = import_torch()
    inputs = np.random.default_rng(0).standard_normal((CHANNELS, 48, 80)).astype(np.float32)
    with torch.inference_mode():
        expected = forward(network.eval(), torch.tensor(inputs[None]))[0].numpy()
    return float(np.abs(net(inputs) - expected).max() / max(float(np.abs(expected).max()), 1e-6))
