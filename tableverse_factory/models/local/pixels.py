"""Preprocessing of images for models: resize and normalize, without torchvision."""

from dataclasses import dataclass
from functools import cache
from typing import Literal

from schemas.geometry import Picture
from tableverse_factory.models.local.device import Device, Tensor, import_torch

Kernel = Literal["bilinear", "bicubic"]


@dataclass(frozen=True, slots=True)
class Normalization:
    """Mean and standard deviation of each colour channel, for values between 0 and 1."""

    mean: tuple[float, float, float]
    deviation: tuple[float, float, float]


IMAGENET = Normalization((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))
HALF = Normalization((0.5, 0.5, 0.5), (0.5, 0.5, 0.5))


def upload_image(picture: Picture, device: Device) -> Tensor:
    """Copy a picture to the device as uint8, shape (h, w, 3); it is resized there."""
    torch = import_torch()
    on_gpu = device.kind == "cuda"
    host = torch.empty(picture.shape, dtype=torch.uint8, pin_memory=on_gpu)
    host.numpy()[...] = picture
    return host.to(device.torch_device, non_blocking=True) if on_gpu else host


def compute_pixel_values(
    pictures: list[Tensor], size: tuple[int, int], normal: Normalization, device: Device, kernel: Kernel = "bilinear"
) -> Tensor:
    """Resize and normalize pictures to one batch, shape (n, 3, height, width), in the device's precision.

    Resizes as torchvision does with `antialias=True`, to a height and width that need not keep the aspect ratio; values
    are rounded before they are normalized, as in training. Pictures are uint8 on the device, of shape (h, w, 3) each.
    """
    mean, deviation = _upload_constants(normal, device)
    planes = import_torch().cat([_resize(picture, size, kernel) for picture in pictures])
    return ((planes - mean) / deviation).to(device.dtype)


@cache
def _upload_constants(normal: Normalization, device: Device) -> tuple[Tensor, Tensor]:
    """Upload mean and deviation for values up to 255; cached, for a copy of unpinned memory waits for the GPU."""
    tensor = import_torch().tensor
    mean, deviation = (tensor(values, device=device.torch_device) for values in (normal.mean, normal.deviation))
    return mean.view(1, 3, 1, 1) * 255.0, deviation.view(1, 3, 1, 1) * 255.0


def _resize(picture: Tensor, size: tuple[int, int], kernel: Kernel) -> Tensor:
    torch = import_torch()
    planes = picture.permute(2, 0, 1)[None].to(torch.float32)
    if planes.shape[-2:] == size:
        return planes
    resized = torch.nn.functional.interpolate(planes, size, mode=kernel, align_corners=False, antialias=True)
    return resized.round().clamp(0.0, 255.0)
