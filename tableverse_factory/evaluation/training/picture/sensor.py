"""A sensor's depth for training views, on their device: noise that grows with z², steps, holes, and ragged edges.

The model is that of `sources.synthetic.sensor`, over batches and a wider spread of sensors.
"""

from typing import Any

from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()
functional = torch.nn.functional

BASELINE_M = (0.05, 0.11)
NOISE_PX = (0.0, 0.06)  # of the disparity
STEP_PX = 1 / 24
WOBBLE_PX = (0.0, 0.9)  # displacement of readings at edges
FARTHEST_M = 4.0
NEAREST_M = 0.15


def sense_depth(depth: Tensor, normals: Tensor, shine: Tensor, light: Tensor, rays: Tensor, focal: Tensor) -> Tensor:
    """Simulate readings [m], 0 where there is none.

    `depth` [m], `shine` 0-1 and `light` (grey, 0-1) have shape (b, h, w), `normals` and unit `rays` (b, 3, h, w),
    `focal` (b,) [px].
    """
    count, height, width = depth.shape
    device = depth.device

    def draw(low: float, high: float) -> Tensor:
        return (low + (high - low) * torch.rand(count, device=device))[:, None, None]

    readings = _displace(depth, draw(*WOBBLE_PX))
    per_metre = focal[:, None, None] * draw(*BASELINE_M)
    noise = 0.7 * (torch.randn_like(depth) + _draw_smooth(count, height, width, 2, device))
    disparity = per_metre / readings.clamp(min=0.05) + draw(*NOISE_PX) * noise
    step = STEP_PX * draw(0.05, 1.5)
    disparity = ((disparity / step).round() * step).clamp(min=0.05)
    lost = _find_shadows(per_metre / depth, draw(0, 1) < 0.5) & (draw(0, 1) < 0.7)
    lost = lost | _find_holes(depth, normals, shine, light, rays, draw)
    sensed = per_metre / disparity
    lost = lost | (depth > FARTHEST_M) | (depth < NEAREST_M)
    return torch.where(lost, torch.zeros_like(sensed), sensed)


def _displace(depth: Tensor, reach: Tensor) -> Tensor:
    """Take each reading from a neighbour, as far away as smooth noise says [px]."""
    count, height, width = depth.shape
    ys, xs = torch.meshgrid(
        torch.arange(height, device=depth.device), torch.arange(width, device=depth.device), indexing="ij"
    )
    moved = []
    for base, size in ((ys, height), (xs, width)):
        shift = (_draw_smooth(count, height, width, 2, depth.device) * reach).round().long()
        moved.append((base + shift).clamp(0, size - 1))
    return depth.flatten(1).gather(1, (moved[0] * width + moved[1]).flatten(1)).reshape(depth.shape)


def _draw_smooth(count: int, height: int, width: int, reach: int, device: Any) -> Tensor:
    """Draw noise of about unit variance, correlated over `reach` pixels."""
    coarse = torch.randn(count, 1, -(-height // reach) + 2, -(-width // reach) + 2, device=device)
    fine = functional.interpolate(coarse, scale_factor=float(reach), mode="bilinear", align_corners=False)
    return fine[:, 0, :height, :width] * 1.4


def _find_shadows(disparity: Tensor, mirrored: Tensor) -> Tensor:
    """Find what a nearer surface hides from a projector to the left, or to the right."""
    columns = torch.arange(disparity.shape[2], device=disparity.device) + disparity
    left = columns < columns.cummax(dim=2).values - 0.75
    other = torch.arange(disparity.shape[2], device=disparity.device) - disparity
    right = other > -((-other).flip(2).cummax(dim=2).values.flip(2)) + 0.75
    return torch.where(mirrored, right, left)


def _find_holes(depth: Tensor, normals: Tensor, shine: Tensor, light: Tensor, rays: Tensor, draw: Any) -> Tensor:
    """Find grazing, shiny and dark surfaces, edges, and readings lost for no reason."""
    count, height, width = depth.shape
    facing = -(functional.normalize(normals, dim=1) * rays).sum(1)
    grazing = torch.rand_like(depth) > torch.sigmoid((facing - 0.16) / 0.035)
    local = depth[:, None]
    spread = functional.max_pool2d(local, 3, 1, 1) + functional.max_pool2d(-local, 3, 1, 1)
    edge = (spread[:, 0] > 0.02 * depth) & (torch.rand_like(depth) < draw(0.0, 0.9))
    patches = _draw_smooth(count, height, width, 8, depth.device)
    glare = (patches > 2.4 - 2.6 * shine) & (shine > 0.05)
    dark = (light < draw(0.0, 0.12)) & (patches > draw(-1.0, 2.0))
    blots = _draw_smooth(count, height, width, 6, depth.device) > draw(2.4, 5.0)
    single = torch.rand_like(depth) < 0.02 * draw(0.0, 1.0) ** 2
    return grazing | edge | glare | dark | blots | single
