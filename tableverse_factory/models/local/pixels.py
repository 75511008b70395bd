"""Pictures as a model wants them: resized, between 0 and 1, less the mean, over the deviation. No torchvision."""

from dataclasses import dataclass
from functools import cache
from typing import Literal

from schemas.geometry import Picture
from tableverse_factory.models.local.device import Device, Tensor, torch_here

Kernel = Literal["bilinear", "bicubic"]
"""As torch calls it."""


@dataclass(frozen=True, slots=True)
class Normal:
    """Mean and deviation of each colour, of values between 0 and 1."""

    mean: tuple[float, float, float]
    deviation: tuple[float, float, float]


IMAGENET = Normal((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
HALF = Normal((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))


def picture_on(picture: Picture, device: Device) -> Tensor:
    """The picture where the model is, shape (h, w, 3), uint8: bytes travel, resizing is done there."""
    torch = torch_here()
    on_gpu = device.kind == "cuda"
    host = torch.empty(picture.shape, dtype=torch.uint8, pin_memory=on_gpu)
    host.numpy()[...] = picture
    return host.to(device.where, non_blocking=True) if on_gpu else host


def pixel_values(
    pictures: list[Tensor], size: tuple[int, int], normal: Normal, device: Device, kernel: Kernel = "bilinear"
) -> Tensor:
    """Pictures of any sizes as one batch, shape (n, 3, height, width), in the device's precision.

    Resized as torchvision does with `antialias=True`, values rounded to whole ones before they are normalised, which
    is what models saw when they were trained. The aspect is not kept.

    Args:
        pictures: Shape (h, w, 3) each, uint8, on the device.
        size: Height and width that the model wants.
        normal: What it was trained with.
        device: Where it runs.
        kernel: By which it is resized.
    """
    mean, deviation = _constants(normal, device)
    planes = torch_here().cat([_resized(picture, size, kernel) for picture in pictures])
    return ((planes - mean) / deviation).to(device.dtype)


@cache
def _constants(normal: Normal, device: Device) -> tuple[Tensor, Tensor]:
    """Mean and deviation of values up to 255; kept, for a copy of what is not pinned waits for all the GPU's work."""
    tensor = torch_here().tensor
    mean, deviation = (tensor(values, device=device.where) for values in (normal.mean, normal.deviation))
    return mean.view(1, 3, 1, 1) * 255.0, deviation.view(1, 3, 1, 1) * 255.0


def _resized(picture: Tensor, size: tuple[int, int], kernel: Kernel) -> Tensor:
    torch = torch_here()
    planes = picture.permute(2, 0, 1)[None].to(torch.float32)
    if planes.shape[-2:] == size:
        return planes
    interpolate = torch.nn.functional.interpolate
    resized = interpolate(planes, size, mode=kernel, align_corners=False, antialias=True)
    return resized.round().clamp(0.0, 255.0)
