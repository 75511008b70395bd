"""Exposures: what a renderer returns for a pack of views, and pictures developed from them."""

from dataclasses import dataclass
from typing import Any, Protocol

from tableverse_factory.evaluation.training.picture.builder import SceneTables
from tableverse_factory.evaluation.training.picture.columns import View
from tableverse_factory.evaluation.training.picture.tables import TABLE_SIDE, TABLE_TOP
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()
functional = torch.nn.functional

LEAST_TABLE, LEAST_THINGS = 0.02, 0.003  # shares of a picture that shows a table with things
MOST_THINGS = 0.93
NEAREST_M, FARTHEST_M = 0.1, 50.0
KNEE = 0.8  # of the response of a camera's sensor, from which highlights are compressed
GAMMA = 2.2


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """Light and labels of n views, on a device.

    Attributes:
        light: Irradiance, albedo and gloss, linear. Shape (n, h, w, 9).
        depth: [m]. Shape (n, h, w).
        ids: 0 for the room, 1-253 for things, `TABLE_SIDE`, `TABLE_TOP`. Shape (n, h, w), uint8.
        normals: In the camera's frame, in 127ths. Shape (n, h, w, 3), int8.
        shine: 0 for matt to 255 for mirrors and glass. Shape (n, h, w), uint8.
    """

    light: Tensor
    depth: Tensor
    ids: Tensor
    normals: Tensor
    shine: Tensor


class Renderer(Protocol):
    """Renders packs of scenes."""

    def render(self, pack: SceneTables) -> Exposure:
        """Render every view of the pack."""


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """Developed views: images of shape (n, 3, h, w) in bytes, labels as in `Exposure`, rows of cameras."""

    images: Tensor
    depth: Tensor
    ids: Tensor
    normals: Tensor
    shine: Tensor
    cameras: Tensor

    def __len__(self) -> int:
        return len(self.images)

    def select(self, which: Any) -> "Views":
        """Select views by indices, a slice or a mask."""
        return Views(*(getattr(self, name)[which] for name in self.__slots__))


def develop_views(exposure: Exposure, cameras: Tensor, generator: Any) -> Views:
    """Remove the tracer's noise, expose at random, and drop views that show too little, too much or too near."""
    light = exposure.light.permute(0, 3, 1, 2)
    normals = functional.normalize(exposure.normals.permute(0, 3, 1, 2).float(), dim=1)
    irradiance = _smooth(light[:, :3], normals, exposure, (1, 2, 4))
    gloss = _smooth(light[:, 6:9], normals, exposure, (1,))
    images = _expose(irradiance * light[:, 3:6] + gloss, generator)
    views = Views(
        images,
        exposure.depth.clamp(max=FARTHEST_M),
        exposure.ids,
        exposure.normals.permute(0, 3, 1, 2).contiguous(),
        exposure.shine,
        cameras,
    )
    return views.select(_find_useful(views))


def _find_useful(views: Views) -> Tensor:
    things = ((views.ids > 0) & (views.ids < TABLE_SIDE)).flatten(1).float().mean(1)
    table = (views.ids == TABLE_TOP).flatten(1).float().mean(1)
    far = views.depth.flatten(1).amin(1) > NEAREST_M
    is_empty = views.cameras[:, View.THINGS] == 0
    shows = (table >= LEAST_TABLE) & ((things >= LEAST_THINGS) | is_empty) & (things <= MOST_THINGS)
    without = (views.cameras[:, View.HAS_TABLE] == 0) & (table == 0)
    return far & (shows | without)


def _expose(linear: Tensor, generator: Any) -> Tensor:
    """Choose an exposure, compress highlights, and encode as sRGB bytes."""
    count = len(linear)
    draws = torch.rand(2, count, device=linear.device, generator=generator)
    bright = linear.mean(1).flatten(1)[:, ::13].sort(dim=1).values
    index = ((0.6 + 0.35 * draws[0]) * (bright.shape[1] - 1)).long()
    reference = bright.gather(1, index[:, None])[:, 0].clamp(min=1e-4)
    exposed = linear * ((0.45 + 0.5 * draws[1]) / reference)[:, None, None, None]
    soft = KNEE + (1 - KNEE) * (1 - torch.exp(-(exposed - KNEE) / (1 - KNEE)))
    return (torch.where(exposed > KNEE, soft, exposed).clamp(0, 1) ** (1 / GAMMA) * 255).round().byte()


def _smooth(light: Tensor, normals: Tensor, exposure: Exposure, steps: tuple[int, ...]) -> Tensor:
    """Average neighbours of the same surface, ever farther apart (à trous)."""
    ids, nearness = exposure.ids[:, None], exposure.depth[:, None].clamp(min=1e-3).log()
    for step in steps:
        total, weights = torch.zeros_like(light), torch.zeros_like(nearness)
        for dy in (-step, 0, step):
            for dx in (-step, 0, step):
                shift = (dy, dx)
                same = torch.roll(ids, shift, (2, 3)) == ids
                facing = (torch.roll(normals, shift, (2, 3)) * normals).sum(1, keepdim=True).clamp(0, 1) ** 24
                apart = (torch.roll(nearness, shift, (2, 3)) - nearness).abs()
                weight = same * facing * torch.exp(-apart * 30 / step) * (0.5 if dx or dy else 1.0)
                total, weights = total + torch.roll(light, shift, (2, 3)) * weight, weights + weight
        light = total / weights.clamp(min=1e-6)
    return light
