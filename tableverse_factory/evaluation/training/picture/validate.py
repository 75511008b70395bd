"""Figures of a network on held-out rendered views."""

from collections.abc import Iterable
from typing import Any

from tableverse_factory.evaluation.training.picture.exposure import Views
from tableverse_factory.evaluation.training.picture.losses import ThingTargets, find_targets
from tableverse_factory.evaluation.training.picture.samples import Sample, make_sample
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

THING = 2


def validate_network(network: Any, batches: Iterable[Views], device: str, with_depth: bool) -> dict[str, float]:
    """Measure the network on views, with a sensor's depth or without.

    Returns:
        `depth`: mean relative error on table and things, one scale per view taken out. `scale`: median error of that
        scale. `covered`: share of views whose scale is within its stated deviation. `normal_deg`: median error of the
        plane's normal. `things`: intersection over union of all things together. `votes_px`: mean error of votes.
        `table`: share of views of which it is known whether they show a table.
    """
    parts: list[dict[str, Tensor]] = []
    for views in batches:
        torch.manual_seed(0)
        sample = make_sample(views, augment=False, depth_share=float(with_depth))
        with torch.no_grad(), torch.autocast(device, torch.bfloat16, enabled=device == "cuda"):
            outputs = network(sample.image, sample.rays, sample.sensed)
        parts.append(_measure(outputs, sample, find_targets(sample)))
    each = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    seen, with_things = each["shows"] & (each["inner"] > 0), each["things"] > 0
    scale = each["scale"][seen].abs()
    return {
        "depth": float(each["depth"][seen].mean()),
        "scale": float(scale.median()),
        "covered": float((scale <= each["sigma"][seen]).float().mean()),
        "normal_deg": float(each["normal_deg"][seen].median()),
        "things": float(each["overlap"][with_things].mean()),
        "votes_px": float(each["votes_px"][with_things].mean()),
        "table": float((each["says"] == each["shows"]).float().mean()),
    }


def _measure(outputs: tuple[Tensor, ...], sample: Sample, targets: ThingTargets) -> dict[str, Tensor]:
    """Measure each view; `inner` and `things` are numbers of pixels."""
    label, log_depth, _, _, votes, _, _, plane, table, sigma = outputs
    things = sample.things
    inner = (things | sample.tops).float()
    pixels, thing_pixels = inner.sum((1, 2)), things.flatten(1).sum(1)
    error = (log_depth[:, 0] - sample.depth.log()) * inner
    scale = error.sum((1, 2)) / pixels.clamp(min=1)
    aligned = (torch.exp(error - scale[:, None, None]) - 1).abs() * inner
    found = label.argmax(1) == THING
    union = (found | things).flatten(1).sum(1).clamp(min=1)
    off = (votes - targets.votes).abs().sum(1) * things
    cosine = (plane[:, :3] * sample.plane[:, :3]).sum(1).clamp(-1, 1)
    figures = {
        "depth": aligned.sum((1, 2)) / pixels.clamp(min=1),
        "scale": scale,
        "sigma": sigma[:, 0],
        "normal_deg": torch.rad2deg(torch.acos(cosine)),
        "overlap": (found & things).flatten(1).sum(1) / union,
        "votes_px": off.sum((1, 2)) / thing_pixels.clamp(min=1),
        "says": table[:, 0] > 0,
        "shows": sample.table > 0,
        "inner": pixels,
        "things": thing_pixels,
    }
    return {name: figure.cpu() for name, figure in figures.items()}
