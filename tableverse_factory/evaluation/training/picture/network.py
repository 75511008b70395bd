"""The network of pictures: a residual U-Net with attention at a sixteenth, for colour, rays and a sensor's depth."""

from typing import Any

from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()
nn, functional = torch.nn, torch.nn.functional
Module: Any = nn.Module

WIDTHS = (48, 96, 192, 320)  # channels at 1/2, 1/4, 1/8 and 1/16 of the height and width
BLOCKS = (1, 3, 4, 3)
ATTENTION = 6
HEADS = 8
FULL, NARROW = 16, 32  # channels at full size, on the way in and out
CHANNELS = 8  # colour, slopes of the rays and their square, log depth and whether there is any
REFERENCE_PX = 300.0  # focal length at which the network sees depth as it is
VOTE_PX = 32.0
HEIGHT_UNIT = 0.1
DENSE = 16  # three classes, log depth, trust in the sensor, height, centre, two votes, boundary, six affinities
GLOBAL = 6  # normal, log distance, whether there is a table, log of the scale's deviation


class Convolution(Module):  # type: ignore[misc]
    """A convolution, batch norm, and ReLU unless it is `linear`."""

    def __init__(self, inputs: int, outputs: int, kernel: int = 3, stride: int = 1, linear: bool = False) -> None:
        super().__init__()
        self.convolve = nn.Conv2d(inputs, outputs, kernel, stride, kernel // 2, bias=False)
        self.norm = nn.BatchNorm2d(outputs, momentum=0.05)
        self.linear = linear

    def forward(self, x: Tensor) -> Tensor:
        """Map (b, inputs, h, w) to (b, outputs, h/stride, w/stride)."""
        x = self.norm(self.convolve(x))
        return x if self.linear else functional.relu(x)


class Residual(Module):  # type: ignore[misc]
    """Two convolutions added to their input; at first it passes its input on."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = Convolution(width, width)
        self.second = Convolution(width, width, linear=True)
        nn.init.zeros_(self.second.norm.weight)

    def forward(self, x: Tensor) -> Tensor:
        """Map (b, c, h, w) to the same shape."""
        return functional.relu(x + self.second(self.first(x)))


class Attention(Module):  # type: ignore[misc]
    """A transformer layer."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.before, self.between = nn.LayerNorm(width), nn.LayerNorm(width)
        self.mix, self.join = nn.Linear(width, 3 * width), nn.Linear(width, width)
        self.widen, self.narrow = nn.Linear(width, 3 * width), nn.Linear(3 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        """Map tokens (b, n, c) to the same shape."""
        batch, count, width = x.shape
        mixed = self.mix(self.before(x)).reshape(batch, count, 3, HEADS, width // HEADS).permute(2, 0, 3, 1, 4)
        query, key, value = mixed.unbind(0)
        if torch.onnx.is_in_onnx_export():
            scores = (query * (width // HEADS) ** -0.5) @ key.transpose(-1, -2)
            heads = scores.softmax(-1) @ value
        else:
            heads = functional.scaled_dot_product_attention(query, key, value)
        x = x + self.join(heads.transpose(1, 2).reshape(batch, count, width))
        return x + self.narrow(functional.gelu(self.widen(self.between(x))))


class PictureNetwork(Module):  # type: ignore[misc]
    """Image, rays and depth in; the outputs that `models.picture.net` describes out."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = WIDTHS
        self.full = Convolution(CHANNELS, FULL)
        self.down = nn.ModuleList(
            [Convolution(CHANNELS, a, 5, 2), Convolution(a, b, 3, 2), Convolution(b, c, 3, 2), Convolution(c, d, 3, 2)]
        )
        self.levels = nn.ModuleList(
            [nn.Sequential(*(Residual(w) for _ in range(count))) for w, count in zip(WIDTHS, BLOCKS, strict=True)]
        )
        self.place = nn.Sequential(nn.Linear(6, 64), nn.GELU(), nn.Linear(64, d))
        self.whole = nn.Parameter(torch.zeros(1, 1, d))
        self.attention = nn.ModuleList([Attention(d) for _ in range(ATTENTION)])
        self.norm = nn.LayerNorm(d)
        self.up = nn.ModuleList(
            [Convolution(d + c, c), Convolution(c + b, b), Convolution(b + a, 64), Convolution(64 + FULL, NARROW)]
        )
        self.refine = nn.ModuleList([Residual(c), Residual(b), Residual(64), Convolution(NARROW, NARROW)])
        self.dense = nn.Conv2d(NARROW, DENSE, 1)
        self.summary = nn.Linear(d, GLOBAL)
        with torch.no_grad():
            self.dense.weight.mul_(0.2)
            self.dense.bias.copy_(torch.tensor([0.0, 0, 0, 0, 0, 0, -3, 0, 0, -2, 0, 0, 0, 0, 0, 0]))

    def forward(self, image: Tensor, rays: Tensor, depth: Tensor) -> tuple[Tensor, ...]:
        """Compute the maps and the vectors of `PictureNet`, in the order of `MAPS` and `VECTORS`."""
        slopes = rays[:, :2] / rays[:, 2:].clamp(min=0.05)
        steps = (slopes[:, :1, :, 1:] - slopes[:, :1, :, :-1]).mean((1, 2, 3)).clamp(min=1e-6)
        zoom = -(steps * REFERENCE_PX).log()[:, None, None, None]  # of the focal length against the reference
        known = (depth > 0).to(depth.dtype)
        sensed = depth.clamp(min=0.05, max=50.0).log() - zoom
        tilt = slopes.square().sum(1, keepdim=True)
        inputs = torch.cat([image * 4 - 2, slopes * 2, tilt, sensed * known, known], dim=1)
        dense, summary = self._compute(inputs, slopes)
        label, free, trust, share, center, votes, boundary, affinity = dense.split([3, 1, 1, 1, 1, 2, 1, 6], dim=1)
        trust = torch.sigmoid(trust) * known
        log_depth = free + trust * (sensed - free) + zoom
        normal = functional.normalize(summary[:, :3], dim=1)
        distance = (summary[:, 3:4] + zoom[:, :, 0, 0]).exp()
        return (
            label,
            log_depth,
            share * HEIGHT_UNIT,
            center,
            votes * VOTE_PX,
            boundary,
            affinity,
            torch.cat([normal, distance], dim=1),
            summary[:, 4:5],
            summary[:, 5:6].clamp(-5.0, 1.0).exp(),
        )

    def _compute(self, inputs: Tensor, slopes: Tensor) -> tuple[Tensor, Tensor]:
        levels = [self.full(inputs)]
        x = inputs
        for down, level in zip(self.down, self.levels, strict=True):
            x = level(down(x))
            levels.append(x)
        batch, width, height, across = x.shape
        ray = functional.avg_pool2d(slopes, 16)
        square = torch.cat([ray, ray * ray, ray[:, :1] * ray[:, 1:], torch.ones_like(ray[:, :1])], dim=1)
        tokens = x.flatten(2).transpose(1, 2) + self.place(square.flatten(2).transpose(1, 2))
        tokens = torch.cat([self.whole.expand(batch, -1, -1).to(tokens.dtype), tokens], dim=1)
        for layer in self.attention:
            tokens = layer(tokens)
        tokens = self.norm(tokens)
        x = tokens[:, 1:].transpose(1, 2).reshape(batch, width, height, across)
        for up, refine, skip in zip(self.up, self.refine, reversed(levels[:-1]), strict=True):
            larger = functional.interpolate(x, scale_factor=2.0, mode="nearest")
            x = refine(up(torch.cat([larger, skip], dim=1)))
        return self.dense(x).float(), self.summary(tokens[:, 0]).float()


def make_network(seed: int) -> Any:
    """Make the network with weights from a seed, on the CPU."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return PictureNetwork()
