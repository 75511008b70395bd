"""Lesson on pictures: marking what instructions name, and goals about points that are seen."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.evaluation.training.policy import validate
from tableverse_factory.evaluation.training.policy.goals import GRASP_UNIT_M, PLACE_UNIT_M
from tableverse_factory.evaluation.training.policy.instructions import Wordings
from tableverse_factory.evaluation.training.policy.lessons import autocast
from tableverse_factory.evaluation.training.policy.losses import compute_flow_loss
from tableverse_factory.evaluation.training.policy.packed_pictures import DEPTH_M, PackedPictures
from tableverse_factory.evaluation.training.policy.rotations import matrix_from_quaternion
from tableverse_factory.evaluation.training.policy.samples import GoalBatch, draw_rows, sample_goals
from tableverse_factory.evaluation.training.policy.seen_points import Rays, compute_rays, gather_points
from tableverse_factory.evaluation.training.policy.settings import PolicySettings
from tableverse_factory.evaluation.training.policy.sight import describe_points, make_picture_network
from tableverse_factory.evaluation.training.policy.tensors import DemonstrationTensors
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()
functional = torch.nn.functional

BRIGHTNESS, TINT = 0.2, 0.04  # deviations of a view, and of the colours of a picture, whose names are to hold
NOISE = 0.02  # of pixels
DEPTH_NOISE_M = 0.001
SCALE, TURN_RAD, SHIFT = 0.12, 0.1, 0.08  # deviations of how views are moved; shifts in halves of the picture
HIDDEN = 0.3  # share of scenes of whose X and Y a side is hidden, as marks may miss it
MARK_WEIGHT = 10.0  # few pixels are marked
MARKED = 0.5  # overlap from which an object counts as found


class PictureTensors:
    """Packed pictures as tensors on a device."""

    def __init__(self, packed: PackedPictures, device: str) -> None:
        colors, depth, objects = packed.decode()
        self.colors = torch.tensor(colors, device=device).permute(0, 1, 4, 2, 3).contiguous()
        self.depth = torch.tensor(depth, device=device).flatten(1)
        self.objects = torch.tensor(objects, device=device).flatten(1)
        self._intrinsics = torch.tensor(packed.intrinsics, device=device)
        self._mounts = torch.tensor(packed.mounts, device=device)
        bases = torch.tensor(packed.bases, device=device)
        self.base_at, self.base_turn = bases[:, :3], matrix_from_quaternion(bases[:, 3:])
        self.words = torch.tensor(packed.words, device=device)
        self.wordings = Wordings(torch.tensor(packed.wordings.astype("int64"), device=device))
        held_out = torch.tensor(packed.held_out.astype(bool), device=device)
        self.choices = {wanted: (held_out == wanted).nonzero()[:, 0] for wanted in (False, True)}

    def compute_rays(self, views: Tensor) -> Rays:
        """Compute the rays of views, (b,)."""
        return compute_rays(self._intrinsics[views], self._mounts)

    def read_depth(self, views: Tensor, augment: bool) -> Tensor:
        """Read the depth of views [m]. Shapes (b,) and (b, m)."""
        depth = self.depth[views].float() * DEPTH_M
        return depth + DEPTH_NOISE_M * torch.randn_like(depth) * (depth > 0) * augment


class PictureLesson:
    """Sight from all views; goals from the first ones; motions are those of a policy on states and stay as they are."""

    rate_factors: Mapping[str, float] = MappingProxyType({"goal": 0.1})  # its goals know more motions than these

    def __init__(self, data: DemonstrationTensors, pictures: PictureTensors, teacher: Any) -> None:
        """Take demonstrations, their pictures, and the networks of a policy on states."""
        own = pictures.base_at[: len(data.last)]
        if own.shape != data.base_at.shape or not torch.allclose(own, data.base_at, atol=1e-5):
            raise InputError("the pictures are not those of the demonstrations: pack both from the same datasets")
        self._data, self._pictures, self._teacher = data, pictures, teacher

    def make_network(self, seed: int) -> Any:
        """Make the networks on the CPU."""
        made = make_picture_network(seed)
        made.goal.load_state_dict(self._teacher.goal.state_dict())
        made.motion.load_state_dict(self._teacher.motion.state_dict())
        return made

    def _draw_queries(self, count: int, held_out: bool, augment: bool) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
        """Draw what sight is told, and what it is to mark: 1 or 0, of the shape of its scores."""
        own = self._pictures
        views = draw_rows(own.choices[held_out], count)
        colors = own.colors[views].float() / 255
        if augment:
            light = BRIGHTNESS * torch.randn(count, 1, 1, 1, 1, device=views.device)
            tint = TINT * torch.randn(count, colors.shape[1], 3, 1, 1, device=views.device)
            colors = colors * torch.exp(light + tint)
            colors = (colors + NOISE * torch.randn_like(colors)).clamp(0.0, 1.0)
        told = describe_points(own.compute_rays(views), own.read_depth(views, augment), own.base_turn[views])
        objects, words = own.objects[views], own.words[views].long()
        named = words[:, :, 0, 0] > 0
        pair = torch.where(named, torch.rand(named.shape, device=views.device), -1.0).topk(2, 1).indices
        phrases = [self._draw_phrases(words, pair[:, k]) for k in range(2)]
        asked = named.gather(1, pair)  # fewer than two may be named
        marks = [(objects == 1 + pair[:, k, None]) & asked[:, k, None] for k in range(2)]
        marks = torch.stack([*marks, objects > 0], 1)
        marks = marks.reshape(count, 3, colors.shape[1], *colors.shape[-2:]).transpose(1, 2).float()
        if augment:
            colors, told, marks = _move_views(colors, told, marks)
        return (colors, told, own.wordings.compose(*phrases)), marks

    @staticmethod
    def _draw_phrases(words: Tensor, which: Tensor) -> Tensor:
        """Draw a phrase of one object of each view. Shapes (b, o, p, w) and (b,); (b, w)."""
        own = words[torch.arange(len(which), device=which.device), which]
        known = (own[:, :, 0] > 0).sum(1)
        k = (torch.rand(len(which), device=which.device) * known).long()
        return own[torch.arange(len(which), device=which.device), k]

    def _draw_goals(self, count: int, held_out: bool, augment: bool) -> GoalBatch:
        data, own = self._data, self._pictures
        demos = draw_rows(data.choices[held_out][0], count)
        rays = own.compute_rays(demos)
        release = torch.rand(count, device=demos.device) < 0.5
        depth, objects = own.read_depth(demos, augment), own.objects[demos]
        base = own.base_at[demos], own.base_turn[demos]
        masks = [objects == 1, objects == 2, objects > 2]
        if augment:
            masks[:2] = [_hide_side(mask, rays.reach(depth)) for mask in masks[:2]]
        return sample_goals(data, demos, release, augment, gather_points(rays, depth, base, tuple(masks)))

    def compute_losses(self, network: Any, settings: PolicySettings) -> dict[str, Tensor]:
        """Compute the losses of one step on random samples."""
        with torch.no_grad():
            told, marks = self._draw_queries(settings.views, held_out=False, augment=True)
            goals = self._draw_goals(settings.goals, held_out=False, augment=True)
        with autocast(marks):
            scores = network.sight(*told).float()
            memory = network.goal.encode(goals.points, goals.roles, goals.mask, goals.task)
            flow = compute_flow_loss(network.goal, memory, goals.goal, settings.flows)
        marked = MARK_WEIGHT * functional.binary_cross_entropy_with_logits(scores, marks)
        return {"marks": marked, "overlap": _compute_overlap_loss(scores, marks), "flow": flow}

    def measure(self, network: Any, held_out: bool) -> dict[str, float]:
        """Measure sight and goals."""
        with torch.no_grad():
            told, marks = self._draw_queries(validate.GOALS, held_out, augment=False)
            scores = network.sight(*told)[:, :, :2]
            marks = marks[:, :, :2]
            both, either = (scores > 0) & (marks > 0), (scores > 0) | (marks > 0)
            overlap = both.sum((1, 3, 4)) / either.sum((1, 3, 4)).clamp(min=1)
            seen = marks.sum((1, 3, 4)) > 0
            goals = self._draw_goals(validate.GOALS, held_out, augment=False)
            memory = network.goal.encode(goals.points, goals.roles, goals.mask, goals.task)
        figures = {"overlap": float(overlap[seen].mean()), "found": float((overlap[seen] > MARKED).float().mean())}
        units = GRASP_UNIT_M, PLACE_UNIT_M
        return figures | validate.measure_goals(network.goal, memory, goals.goal, goals.release, units)


def _compute_overlap_loss(scores: Tensor, marks: Tensor) -> Tensor:
    """Compute one minus the overlap (Dice) of each mark over all cameras, where anything is to be marked."""
    share = scores.sigmoid()
    both, either = (share * marks).sum((1, 3, 4)), (share + marks).sum((1, 3, 4))
    there = (marks.sum((1, 3, 4)) > 0).float()
    return ((1 - 2 * both / (either + 1.0)) * there).sum() / there.sum().clamp(min=1)


def _move_views(*pictures: Tensor) -> tuple[Tensor, ...]:
    """Scale, turn and shift each camera's window alike in all pictures, (b, cameras, n, h, w); outside they are 0."""
    joined = torch.cat(pictures, 2).flatten(0, 1)
    drawn = torch.randn(len(joined), 4, device=joined.device)
    size, angle, shift = torch.exp(SCALE * drawn[:, :1]), TURN_RAD * drawn[:, 1], SHIFT * drawn[:, 2:]
    height, width = joined.shape[-2:]
    c, s = torch.cos(angle), torch.sin(angle)
    turns = torch.stack([c, -s * height / width, s * width / height, c], 1)
    move = torch.cat([(size * turns).unflatten(1, (2, 2)), shift[..., None]], 2)
    moved = functional.grid_sample(
        joined, functional.affine_grid(move, list(joined.shape), align_corners=False), "nearest", align_corners=False
    )
    return moved.unflatten(0, pictures[0].shape[:2]).split([each.shape[2] for each in pictures], 2)


def _hide_side(mask: Tensor, points: Tensor) -> Tensor:
    """Hide what lies beyond a plane through the middle, or a little beside it, of some objects."""
    along = functional.normalize(torch.randn(len(mask), 3, device=mask.device), dim=1)
    reach = (points * along[:, None]).sum(-1)
    total = mask.sum(1).clamp(min=1)
    middle = (reach * mask).sum(1) / total
    spread = (((reach - middle[:, None]) ** 2 * mask).sum(1) / total).sqrt()
    share = 0.3 + 1.2 * torch.rand(len(mask), device=mask.device)
    hidden = (torch.rand(len(mask), device=mask.device) < HIDDEN)[:, None]
    return mask & ~(hidden & (reach > (middle + share * spread)[:, None]))
