"""The net: a small encoder and decoder that says of each pixel whether it is a thing, and where its thing's middle is.

Described as a list of convolutions, from which both the torch module and the ONNX graph are made: what is trained is
what is exported, and no exporter is needed.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from tableverse_factory.models.local.device import Tensor, torch_here
from tableverse_factory.stages.perceive.learned.features import CHANNELS, OUTPUTS

WIDTHS = (32, 64, 128, 224)
"""Channels at one half, a quarter, an eighth and a sixteenth of the input's height and width."""


@dataclass(frozen=True, slots=True)
class Layer:
    """A convolution, normalised and rectified unless it is `plain`.

    Attributes:
        name: Of its weights.
        source: Which result it reads.
        inputs: Channels in.
        outputs: Channels out.
        kernel: Side of the kernel [px].
        stride: 2 halves height and width.
        dilation: Spacing of the kernel's taps [px].
        plain: Neither normalised nor rectified.
        onto: A coarser result that is added, each pixel of it to four, before the rectifier.
    """

    name: str
    source: str
    inputs: int
    outputs: int
    kernel: int = 3
    stride: int = 1
    dilation: int = 1
    plain: bool = False
    onto: str = ""

    @property
    def padding(self) -> int:
        """That keeps the size at stride 1 [px]."""
        return self.dilation * (self.kernel // 2)


def layers() -> tuple[Layer, ...]:
    """All convolutions in the order in which they are computed; the first reads `input`, the last gives `output`."""
    a, b, c, d = WIDTHS
    return (
        Layer("half_in", "input", CHANNELS, a, stride=2),
        Layer("halves", "half_in", a, a),
        Layer("quarter_in", "halves", a, b, stride=2),
        Layer("quarters", "quarter_in", b, b),
        Layer("eighth_in", "quarters", b, c, stride=2),
        Layer("eighths", "eighth_in", c, c),
        Layer("sixteenth_in", "eighths", c, d, stride=2),
        Layer("sixteenths", "sixteenth_in", d, d),
        Layer("wide", "sixteenths", d, d, dilation=2),
        Layer("wider", "wide", d, d, dilation=4),
        Layer("to_eighth", "wider", d, c, 1, plain=True),
        Layer("eighth_up", "eighths", c, c, onto="to_eighth"),
        Layer("to_quarter", "eighth_up", c, b, 1, plain=True),
        Layer("quarter_up", "quarters", b, b, onto="to_quarter"),
        Layer("quarter_out", "quarter_up", b, b),
        Layer("to_half", "quarter_out", b, a, 1, plain=True),
        Layer("half_up", "halves", a, a, onto="to_half"),
        Layer("half_out", "half_up", a, a),
        Layer("output", "half_out", a, OUTPUTS, 1, plain=True),
    )


def multiply_adds(height: int, width: int) -> int:
    """Of one forward pass over an input of this size."""
    scale, total = {"input": 1}, 0
    for layer in layers():
        scale[layer.name] = scale[layer.source] * layer.stride
        pixels = (height // scale[layer.name]) * (width // scale[layer.name])
        total += pixels * layer.inputs * layer.outputs * layer.kernel**2
    return total


def new_network(seed: int) -> Any:
    """The net with weights drawn from the seed, on the CPU: a `torch.nn.ModuleDict` for `forward`."""
    torch = torch_here()
    nn = torch.nn
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return nn.ModuleDict(
            {
                layer.name: nn.ModuleList(
                    [
                        nn.Conv2d(
                            layer.inputs,
                            layer.outputs,
                            layer.kernel,
                            layer.stride,
                            layer.padding,
                            layer.dilation,
                            bias=layer.plain,
                        ),
                        *([] if layer.plain else [nn.BatchNorm2d(layer.outputs)]),
                    ]
                )
                for layer in layers()
            }
        )


def forward(network: Any, inputs: Tensor) -> Tensor:
    """Inputs of shape (b, 7, h, w) to outputs of shape (b, 4, h/2, w/2)."""
    functional = torch_here().nn.functional
    results = {"input": inputs}
    for layer in layers():
        result = results[layer.source]
        for part in network[layer.name]:
            result = part(result)
        if layer.onto:
            result = result + functional.interpolate(results[layer.onto], scale_factor=2.0, mode="nearest")
        results[layer.name] = result if layer.plain else functional.relu(result)
    return results["output"]


def folded(network: Any) -> Mapping[str, tuple[Any, Any]]:
    """Kernel and bias of each layer as numpy arrays, the normalisation of a trained net taken into them."""
    result = {}
    for layer in layers():
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
