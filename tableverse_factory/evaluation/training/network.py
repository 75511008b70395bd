"""The segmentation network: a small encoder and decoder for objectness and offset to the object centre per pixel.

It is a list of convolutions from which both the torch module and the ONNX graph are made, so no exporter is needed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tableverse_factory.models.local.device import Tensor, import_torch
from tableverse_factory.stages.perceive.learned.net_format import CHANNELS, OUTPUTS

WIDTHS = (32, 64, 128, 224)  # channels at 1/2, 1/4, 1/8 and 1/16 of the height and width of the input


@dataclass(frozen=True, slots=True)
class ConvLayer:
    """A convolution with batch norm and ReLU unless it is `plain`."""

    name: str  # of its weights and its result
    source: str
    inputs: int
    outputs: int
    kernel: int = 3  # side [px]
    stride: int = 1  # [px]
    dilation: int = 1  # spacing of the kernel's taps [px]
    plain: bool = False  # without batch norm and ReLU
    onto: str = ""  # a coarser result that is upsampled and added before the ReLU

    @property
    def padding(self) -> int:
        """Padding that keeps the size at stride 1 [px]."""
        return self.dilation * (self.kernel // 2)


def list_layers() -> tuple[ConvLayer, ...]:
    """List the convolutions in the order of computation; the first reads `input`, the last gives `output`."""
    a, b, c, d = WIDTHS
    return (
        ConvLayer("half_in", "input", CHANNELS, a, stride=2),
        ConvLayer("halves", "half_in", a, a),
        ConvLayer("quarter_in", "halves", a, b, stride=2),
        ConvLayer("quarters", "quarter_in", b, b),
        ConvLayer("eighth_in", "quarters", b, c, stride=2),
        ConvLayer("eighths", "eighth_in", c, c),
        ConvLayer("sixteenth_in", "eighths", c, d, stride=2),
        ConvLayer("sixteenths", "sixteenth_in", d, d),
        ConvLayer("wide", "sixteenths", d, d, dilation=2),
        ConvLayer("wider", "wide", d, d, dilation=4),
        ConvLayer("to_eighth", "wider", d, c, 1, plain=True),
        ConvLayer("eighth_up", "eighths", c, c, onto="to_eighth"),
        ConvLayer("to_quarter", "eighth_up", c, b, 1, plain=True),
        ConvLayer("quarter_up", "quarters", b, b, onto="to_quarter"),
        ConvLayer("quarter_out", "quarter_up", b, b),
        ConvLayer("to_half", "quarter_out", b, a, 1, plain=True),
        ConvLayer("half_up", "halves", a, a, onto="to_half"),
        ConvLayer("half_out", "half_up", a, a),
        ConvLayer("output", "half_out", a, OUTPUTS, 1, plain=True),
    )


def make_network(seed: int) -> Any:
    """Make the network with weights from a seed, on the CPU: a `torch.nn.ModuleDict` for `forward`."""
    torch = import_torch()
    nn = torch.nn
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = nn.ModuleDict()
        for each in list_layers():
            shape = (each.inputs, each.outputs, each.kernel, each.stride, each.padding, each.dilation)
            norm = [] if each.plain else [nn.BatchNorm2d(each.outputs)]
            network[each.name] = nn.ModuleList([nn.Conv2d(*shape, bias=each.plain), *norm])
        return network


def forward(network: Any, inputs: Tensor) -> Tensor:
    """Map inputs of shape (b, 7, h, w) to outputs of shape (b, 4, h/2, w/2)."""
    functional = import_torch().nn.functional
    results = {"input": inputs}
    for layer in list_layers():
        result = results[layer.source]
        for part in network[layer.name]:
            result = part(result)
        if layer.onto:
            result = result + functional.interpolate(results[layer.onto], scale_factor=2.0, mode="nearest")
        results[layer.name] = result if layer.plain else functional.relu(result)
    return results["output"]


def fold_batch_norm(network: Any) -> Mapping[str, tuple[Any, Any]]:
    """Return kernel and bias of each layer as numpy arrays with the batch norm folded in."""
    result = {}
    for layer in list_layers():
        parts = list(network[layer.name])
        weight = parts[0].weight.detach().cpu().double()
        if layer.plain:
            bias = parts[0].bias.detach().cpu().double()
        else:
            norm = parts[1]
            gain = norm.weight.detach().cpu().double() / (norm.running_var.cpu().double() + norm.eps).sqrt()
            bias = norm.bias.detach().cpu().double() - norm.running_mean.cpu().double() * gain
            weight = weight * gain[:, None, None, None]
        result[layer.name] = (weight.float().numpy(), bias.float().numpy())
    return result
