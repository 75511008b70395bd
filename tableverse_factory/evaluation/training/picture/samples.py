"""Samples from views, on their device: crops, colours, a camera's faults, a sensor's depth, and what to predict."""

import math
from dataclasses import dataclass

from tableverse_factory.evaluation.training.picture.columns import View
from tableverse_factory.evaluation.training.picture.exposure import FARTHEST_M, GAMMA, Views
from tableverse_factory.evaluation.training.picture.sensor import sense_depth
from tableverse_factory.evaluation.training.picture.tables import TABLE_SIDE, TABLE_TOP
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()
functional = torch.nn.functional

DEPTH_SHARE = 0.2  # of samples that have a sensor's depth
ZOOM_SHARE, MAX_ZOOM = 0.5, 1.7
RECOLOR_SHARE = 0.5  # of samples whose things change colour one by one
SWAP_SHARE = 0.15  # whose surroundings are another picture's
FLAT_SHARE = 0.08  # that are a flat picture: no table and no depth
GREY_SHARE = 0.06
JPEG_SHARE = 0.4
_LUMA = (
    "16 11 10 16 24 40 51 61 12 12 14 19 26 58 60 55 14 13 16 24 40 57 69 56 14 17 22 29 51 87 80 62 "
    "18 22 37 56 68 109 103 77 24 35 55 64 81 104 113 92 49 64 78 87 103 121 120 101 72 92 95 98 112 100 103 99"
)


@dataclass(frozen=True, slots=True, eq=False)
class Sample:
    """A batch on a device; maps have shape (b, h, w).

    Attributes:
        image: RGB in 0-1. Shape (b, 3, h, w).
        rays: Unit directions in the camera's frame. Shape (b, 3, h, w).
        sensed: A sensor's depth [m], 0 where there is none. Shape (b, 1, h, w).
        ids: As in `Exposure`.
        depth: True depth [m].
        height: Of the surface over the table [m].
        plane: Unit normal of the table and its distance from the camera [m]. Shape (b, 4).
        table: 1 where the picture shows a table, else 0. Shape (b,).
        solid: 1 where depth is to be learned: not on flat pictures. Shape (b,).
    """

    image: Tensor
    rays: Tensor
    sensed: Tensor
    ids: Tensor
    depth: Tensor
    height: Tensor
    plane: Tensor
    table: Tensor
    solid: Tensor

    @property
    def things(self) -> Tensor:
        """Where things are."""
        return (self.ids > 0) & (self.ids < TABLE_SIDE)

    @property
    def tops(self) -> Tensor:
        """Where the table's upper face is."""
        return self.ids == TABLE_TOP


def make_sample(
    views: Views,
    augment: bool,
    depth_share: float = DEPTH_SHARE,
    size: tuple[int, int] | None = None,
    flat: Tensor | None = None,
) -> Sample:
    """Make a batch; without `augment` only the sensor is drawn, for the first `depth_share` of the views.

    `size` is the width and height of augmented samples [px], else those of the views. `flat` are pictures that show no
    table, of shape (n, 3, s, s) in bytes, some of which replace samples.
    """
    image, labels, camera = views.images.float() / 255, _stack_labels(views), views.cameras[:, View.INTRINSICS].clone()
    plane = torch.cat([views.cameras[:, View.UP], views.cameras[:, [View.HEIGHT]]], dim=1)
    if augment:
        image, labels, camera, mirrored = _crop(image, labels, camera, size)
        plane = plane * torch.cat([mirrored[:, None], torch.ones_like(plane[:, 1:])], dim=1)
        labels[:, 2] *= mirrored[:, None, None]
    depth, ids = labels[:, 0], labels[:, 1].round().long()
    rays = _compute_rays(camera, image.shape[-2:])
    focal = camera[:, 0]
    along = depth / rays[:, 2]
    height = plane[:, 3, None, None] + along * (plane[:, :3, None, None] * rays).sum(1)
    sensed = sense_depth(depth, labels[:, 2:5], labels[:, 5] / 255, image.mean(1), rays, focal)
    count = len(views)
    if augment:
        has_depth = torch.rand(count, device=depth.device) < depth_share
    else:
        has_depth = torch.arange(count, device=depth.device) < round(count * depth_share)
    sensed = sensed[:, None] * has_depth[:, None, None, None]
    table, solid = views.cameras[:, View.HAS_TABLE].clone(), torch.ones_like(focal)
    if augment:
        image = _swap_surroundings(image, ids, has_depth)
        if flat is not None:
            image, is_flat = _flatten_some(image, has_depth, flat)
            keep = (~is_flat)[:, None, None]
            ids, table, solid = ids * keep, table * ~is_flat, solid * ~is_flat
        image = _shoot(image, ids)
    return Sample(image.clamp(0, 1), rays, sensed, ids, depth.clamp(max=FARTHEST_M), height, plane, table, solid)


def _stack_labels(views: Views) -> Tensor:
    """Stack depth, id, normal and shine. Shape (b, 6, h, w)."""
    parts = (views.depth[:, None], views.ids[:, None].float(), views.normals.float(), views.shine[:, None].float())
    return torch.cat(parts, dim=1)


def _compute_rays(camera: Tensor, size: tuple[int, int]) -> Tensor:
    height, width = size
    ys, xs = torch.meshgrid(
        torch.arange(height, device=camera.device) + 0.0,
        torch.arange(width, device=camera.device) + 0.0,
        indexing="ij",
    )
    focal_x, focal_y, center_x, center_y = camera.T[..., None, None]
    x, y = (xs - center_x) / focal_x, (ys - center_y) / focal_y
    return functional.normalize(torch.stack([x, y, torch.ones_like(x)], dim=1), dim=1)


def _crop(
    image: Tensor, labels: Tensor, camera: Tensor, size: tuple[int, int] | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Crop, mirror at random and resize; the camera follows. Also returns -1 for mirrored views, else 1."""
    count, _, height, width = image.shape
    wide, high = size or (width, height)
    device = image.device
    draws = torch.rand(5, count, device=device)
    zoom = torch.where(draws[0] < ZOOM_SHARE, 1 + (MAX_ZOOM - 1) * draws[1] ** 1.3, torch.ones(count, device=device))
    shift_x, shift_y = (draws[2] * 2 - 1) * (1 - 1 / zoom), (draws[3] * 2 - 1) * (1 - 1 / zoom)
    mirrored = torch.where(draws[4] < 0.5, -1.0, 1.0)
    affine = torch.zeros(count, 2, 3, device=device)
    affine[:, 0, 0], affine[:, 1, 1] = mirrored / zoom, 1 / zoom
    affine[:, 0, 2], affine[:, 1, 2] = shift_x, shift_y
    grid = functional.affine_grid(affine, [count, 1, high, wide], align_corners=True)
    options = {"padding_mode": "border", "align_corners": True}
    image = functional.grid_sample(image, grid, mode="bilinear", **options)
    labels = functional.grid_sample(labels, grid, mode="nearest", **options)
    half_x, half_y = (width - 1) / 2, (height - 1) / 2
    focal_x, focal_y, center_x, center_y = camera.T
    own_x, own_y = (wide - 1) / 2, (high - 1) / 2
    center_x = ((center_x / half_x - 1 - shift_x) * zoom * mirrored + 1) * own_x
    center_y = ((center_y / half_y - 1 - shift_y) * zoom + 1) * own_y
    focal_x, focal_y = focal_x * zoom * own_x / half_x, focal_y * zoom * own_y / half_y
    return image, labels, torch.stack([focal_x, focal_y, center_x, center_y], dim=1), mirrored


def _swap_surroundings(image: Tensor, ids: Tensor, has_depth: Tensor) -> Tensor:
    """Replace what is neither table nor thing by another picture; not where a sensor's depth would contradict it."""
    chosen = (torch.rand(len(image), device=image.device) < SWAP_SHARE) & ~has_depth
    where = chosen[:, None, None] & (ids == 0)
    return torch.where(where[:, None], image.roll(1, 0).flip(3), image)


def _flatten_some(image: Tensor, has_depth: Tensor, flat: Tensor) -> tuple[Tensor, Tensor]:
    """Put a part of a flat picture in the place of some; say which."""
    count, _, height, width = image.shape
    device = image.device
    is_flat = (torch.rand(count, device=device) < FLAT_SHARE) & ~has_depth
    which = torch.randint(len(flat), (count,), device=device)
    part, mirrored = 0.55 + 0.45 * torch.rand(2, count, device=device), torch.rand(count, device=device) < 0.5
    shift = (2 * torch.rand(2, count, device=device) - 1) * (1 - part)
    affine = torch.zeros(count, 2, 3, device=device)
    affine[:, 0, 0], affine[:, 1, 1] = torch.where(mirrored, -part[0], part[0]), part[1]
    affine[:, 0, 2], affine[:, 1, 2] = shift
    grid = functional.affine_grid(affine, [count, 3, height, width], align_corners=False)
    shown = functional.grid_sample(flat[which].float() / 255, grid, padding_mode="border", align_corners=False)
    return torch.where(is_flat[:, None, None, None], shown, image), is_flat


def _shoot(image: Tensor, ids: Tensor) -> Tensor:
    """Imitate a camera: colours of things and light, vignette, contrast, blur, noise, compression, blots."""
    count, _, height, width = image.shape
    device = image.device

    def spread(sigma: float, channels: int = 1) -> Tensor:
        return torch.exp(torch.randn(count, channels, 1, 1, device=device) * sigma)

    def chance(share: float) -> Tensor:
        return (torch.rand(count, device=device) < share)[:, None, None, None]

    linear = _recolor_things(image**GAMMA, ids)
    ys = torch.linspace(-1, 1, height, device=device)[:, None]
    xs = torch.linspace(-1, 1, width, device=device)[None]
    dark = 0.25 * torch.rand(count, 1, 1, 1, device=device) * chance(0.3) * (xs**2 + ys**2)
    linear = (linear * spread(0.1, 3) * spread(0.2) * (1 - dark)).clamp(1e-5, 1)
    image = linear ** (spread(0.15) / GAMMA)
    mean = image.mean((2, 3), keepdim=True)
    image = (image - mean) * spread(0.15) + mean
    grey = image.mean(1, keepdim=True)
    image = grey + (image - grey) * spread(0.3) * ~chance(GREY_SHARE)
    softened = _blur(image, torch.rand(count, device=device) ** 2 * 1.8)
    sharpen = 1.5 * torch.rand(count, 1, 1, 1, device=device) * chance(0.3)
    image = softened + sharpen * (softened - _blur(softened, torch.ones(count, device=device)))
    fine = 0.06 * torch.rand(count, 1, 1, 1, device=device) ** 2 * torch.randn_like(image) * (0.4 + image)
    smooth = functional.avg_pool2d(torch.randn_like(image), 3, 1, 1) * 3
    image = (image + fine + 0.05 * torch.rand(count, 1, 1, 1, device=device) ** 2 * chance(0.5) * smooth).clamp(0, 1)
    packed = round(count * JPEG_SHARE)
    quality = torch.exp(torch.rand(packed, device=device) * 3 - 2.2)
    image = torch.cat([image[: count - packed], _compress(image[count - packed :], quality)])
    return _blot(image)


def _recolor_things(linear: Tensor, ids: Tensor) -> Tensor:
    """Mix the channels of each thing anew in some pictures."""
    count, device = len(linear), linear.device
    changed = torch.rand(count, 32, 1, 1, device=device) < 0.5
    mix = torch.eye(3, device=device) + 0.22 * torch.randn(count, 32, 3, 3, device=device) * changed
    mix = mix / mix.sum(-1, keepdim=True).clamp(min=0.4)
    mix = mix * torch.exp(torch.randn(count, 32, 1, 1, device=device) * 0.22 * changed)
    slot = ids % 31 + 1
    slot = (slot + 32 * torch.arange(count, device=device)[:, None, None]).flatten()
    rows = [mix[:, :, row].reshape(count * 32, 3)[slot].reshape(*ids.shape, 3) for row in range(3)]
    channels = linear.permute(0, 2, 3, 1)
    mixed = torch.stack([(row * channels).sum(-1) for row in rows], dim=1).clamp(0, 1.5)
    chosen = (torch.rand(count, device=device) < RECOLOR_SHARE)[:, None, None, None]
    return torch.where(chosen, mixed, linear)


def _blur(image: Tensor, sigma: Tensor) -> Tensor:
    """Blur each picture by its own Gaussian of up to 9 taps [px]."""
    count, channels, height, width = image.shape
    taps = torch.arange(-4, 5, device=image.device)[None]
    kernel = torch.exp(-0.5 * (taps / sigma[:, None].clamp(min=0.05)) ** 2)
    kernel = (kernel / kernel.sum(1, keepdim=True)).repeat_interleave(channels, 0)
    flat = functional.pad(image, (4, 4, 4, 4), mode="replicate").reshape(1, count * channels, height + 8, width + 8)
    across = functional.conv2d(flat, kernel[:, None, None], groups=count * channels)
    return functional.conv2d(across, kernel[:, None, :, None], groups=count * channels).reshape(image.shape)


def _compress(image: Tensor, quality: Tensor) -> Tensor:
    """Quantise 8 × 8 blocks of cosines as JPEG does; a greater `quality` is coarser."""
    count, _, height, width = image.shape
    turns = torch.arange(8, device=image.device)
    basis = 0.5 * torch.cos((2 * turns[None] + 1) * turns[:, None] * math.pi / 16)
    basis[0] = math.sqrt(1 / 8)
    steps = torch.tensor([float(v) for v in _LUMA.split()], device=image.device).reshape(8, 8) / 255
    steps = steps * quality[:, None, None, None, None, None]
    blocks = image.reshape(count, 3, height // 8, 8, width // 8, 8).permute(0, 1, 2, 4, 3, 5)
    waves = ((basis @ blocks @ basis.T) / steps).round() * steps
    return (basis.T @ waves @ basis).permute(0, 1, 2, 4, 3, 5).reshape(image.shape)


def _blot(image: Tensor) -> Tensor:
    """Cover a few small rectangles."""
    count, _, height, width = image.shape
    device = image.device
    ys, xs = torch.arange(height, device=device)[None, :, None], torch.arange(width, device=device)[None, None]
    x, y, half_x, half_y, chosen = torch.rand(5, count, 1, 1, device=device)
    inside = ((xs - x * width).abs() < 3 + 28 * half_x) & ((ys - y * height).abs() < 3 + 28 * half_y)
    fill = torch.rand(count, 3, 1, 1, device=device) + 0.15 * torch.randn_like(image)
    return torch.where((inside & (chosen < 0.15))[:, None], fill, image).clamp(0, 1)
