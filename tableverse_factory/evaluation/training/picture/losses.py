"""Losses of the network of pictures, and the targets that need counting: centres, votes, boundaries."""

from dataclasses import dataclass
from itertools import product

from tableverse_factory.evaluation.training.picture.network import HEIGHT_UNIT, VOTE_PX
from tableverse_factory.evaluation.training.picture.samples import Sample
from tableverse_factory.models.local.device import Tensor, import_torch
from tableverse_factory.models.picture.net import REACHES

torch = import_torch()
functional = torch.nn.functional

IDS = 256
NEAREST_M, FARTHEST_M = 0.1, 8.0
SURROUNDINGS = 0.15  # weight of depth that is neither table nor thing
EDGE_STEPS = (1, 2, 4)  # at which differences of depth are compared [px]
LEAST_PIXELS = 40.0
WEIGHTS = {"votes": 1.5, "center": 1.0, "boundary": 0.6, "affinity": 0.5, "normal": 4.0, "distance": 0.5}
WEIGHTS |= {"table": 0.3, "sigma": 0.02}
APART = 3.0  # weight of pairs of pixels on two things, of which there are fewer
SMALL = 1e-3  # below which errors of a normal count by their square


@dataclass(frozen=True, slots=True, eq=False)
class ThingTargets:
    """Per pixel: offset to the middle of its thing [px], size of its thing [px²], and whether a border runs by it."""

    votes: Tensor  # (b, 2, h, w)
    pixels: Tensor  # (b, h, w), at least 1
    boundary: Tensor  # (b, h, w), 0 or 1


def find_targets(sample: Sample) -> ThingTargets:
    """Count each thing's pixels and find its middle."""
    ids, things = sample.ids, sample.things
    count, height, width = ids.shape
    device = ids.device
    ys = torch.arange(height, device=device)[None, :, None].expand_as(ids)
    xs = torch.arange(width, device=device)[None, None].expand_as(ids)
    own = torch.where(things, ids, 0)
    key = own.flatten(1)
    one = torch.ones_like(key, dtype=torch.float32)

    def add_up(values: Tensor) -> Tensor:
        return torch.zeros(count, IDS, device=device).scatter_add_(1, key, values)

    pixels = add_up(one).clamp(min=1)
    middle_x, middle_y = add_up(xs.flatten(1).float()) / pixels, add_up(ys.flatten(1).float()) / pixels
    votes = torch.stack([each.gather(1, key).reshape(ids.shape) for each in (middle_x, middle_y)], dim=1)
    votes = (votes - torch.stack([xs, ys], dim=1)) * things[:, None]
    label = own.float()[:, None]
    padded = functional.pad(label, (1, 1, 1, 1), mode="replicate")
    differs = functional.max_pool2d(padded, 3, 1) != -functional.max_pool2d(-padded, 3, 1)
    return ThingTargets(votes, pixels.gather(1, key).reshape(ids.shape), differs[:, 0].float())


def compute_losses(outputs: tuple[Tensor, ...], sample: Sample, targets: ThingTargets) -> dict[str, Tensor]:
    """Compute each term of the loss, weighted; their sum is what is minimised."""
    label, log_depth, height, center, votes, boundary, affinity, plane, table, sigma = outputs
    things, tops = sample.things, sample.tops
    classes = torch.where(things, 2, torch.where(tops, 1, 0))
    losses = {"label": functional.cross_entropy(label, classes)}
    losses |= _compare_depth(log_depth[:, 0], sample, sigma[:, 0])
    losses["height"] = _compare_height(height[:, 0], sample)
    thing = things.float()
    share = thing / targets.pixels.clamp(min=LEAST_PIXELS) ** 0.75
    off = (votes - targets.votes).abs().sum(1) / VOTE_PX
    losses["votes"] = WEIGHTS["votes"] * (off * share).sum() / share.sum().clamp(min=1e-6)
    square = targets.votes.pow(2).sum(1)
    reach = (0.12 * targets.pixels.sqrt()).clamp(2.0, 7.0)
    heat = thing * torch.exp(-0.5 * square / reach**2)
    losses["center"] = WEIGHTS["center"] * _compare_logits(center[:, 0], heat, 1 + 8 * heat)
    edge = targets.boundary
    losses["boundary"] = WEIGHTS["boundary"] * _compare_logits(boundary[:, 0], edge, 1 + 3 * edge)
    losses["affinity"] = WEIGHTS["affinity"] * _compare_affinities(affinity, sample)
    shown = sample.table
    present = shown.sum().clamp(min=1)
    error = ((plane[:, :3] - sample.plane[:, :3]).square().sum(1) + SMALL**2).sqrt() - SMALL
    losses["normal"] = WEIGHTS["normal"] * (error * shown).sum() / present
    apart = (plane[:, 3].clamp(min=1e-3).log() - sample.plane[:, 3].clamp(min=0.05).log()).abs()
    losses["distance"] = WEIGHTS["distance"] * (apart * shown).sum() / present
    losses["table"] = WEIGHTS["table"] * functional.binary_cross_entropy_with_logits(table[:, 0], shown)
    return losses


def _compare_logits(logits: Tensor, wanted: Tensor, weight: Tensor) -> Tensor:
    return functional.binary_cross_entropy_with_logits(logits, wanted, weight)


def _compare_affinities(affinity: Tensor, sample: Sample) -> Tensor:
    """Compare whether pixels that lie apart by each reach are of one thing, where both are of things."""
    total, weights = torch.zeros((), device=affinity.device), torch.zeros((), device=affinity.device)
    height, width = sample.ids.shape[1:]
    for index, (reach, axis) in enumerate(product(REACHES, (2, 1))):
        length = (width if axis == 2 else height) - reach
        one, other = (sample.ids.narrow(axis, start, length) for start in (0, reach))
        both = sample.things.narrow(axis, 0, length) & sample.things.narrow(axis, reach, length)
        same = (one == other).float()
        weight = both * (same + APART * (1 - same))
        logits = affinity[:, index].narrow(axis, 0, length)
        total = total + functional.binary_cross_entropy_with_logits(logits, same, weight, reduction="sum")
        weights = weights + weight.sum()
    return total / weights.clamp(min=1)


def _compare_depth(log_depth: Tensor, sample: Sample, sigma: Tensor) -> dict[str, Tensor]:
    """Compare depth with its scale, without it, by its steps, and the scale's stated deviation with its error."""
    wanted = sample.depth.clamp(NEAREST_M, FARTHEST_M).log()
    error = log_depth - wanted
    solid = sample.solid[:, None, None]
    inner = (sample.things | sample.tops).float() * solid
    pixels = inner.sum((1, 2))
    any_inner = (pixels > 0).float()
    pixels = pixels.clamp(min=1)
    rest = SURROUNDINGS * (error.abs() * (1 - inner) * solid).mean()
    plain = ((error.abs() * inner).sum((1, 2)) / pixels).mean() + rest
    scale = (error * inner).sum((1, 2)) / pixels
    shape = (((error - scale[:, None, None]).abs() * inner).sum((1, 2)) / pixels).mean()
    steps = torch.zeros((), device=error.device)
    for step in EDGE_STEPS:
        across = (error[:, :, step:] - error[:, :, :-step]).abs() * inner[:, :, step:] * inner[:, :, :-step]
        down = (error[:, step:] - error[:, :-step]).abs() * inner[:, step:] * inner[:, :-step]
        steps = steps + across.clamp(max=0.5).mean() + down.clamp(max=0.5).mean()
    likelihood = (0.5 * (scale.detach() / sigma) ** 2 + sigma.log()) * any_inner
    return {
        "depth": plain,
        "shape": 4 * shape,
        "steps": 2 * steps,
        "sigma": WEIGHTS["sigma"] * likelihood.sum() / any_inner.sum().clamp(min=1),
    }


def _compare_height(height: Tensor, sample: Sample) -> Tensor:
    """Compare height over depth, on things and on the table alike."""
    wanted = sample.height / sample.depth.clamp(min=NEAREST_M)
    error = ((height - wanted).abs() / HEIGHT_UNIT).clamp(max=4)
    parts = [(error * mask).sum() / mask.sum().clamp(min=1) for mask in (sample.things.float(), sample.tops.float())]
    return 0.5 * (parts[0] + parts[1])
