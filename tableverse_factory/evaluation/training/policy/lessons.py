"""Lessons: what a training makes, the losses of a step, and figures of what was learnt."""

from typing import Any, Protocol

from tableverse_factory.evaluation.training.policy import validate
from tableverse_factory.evaluation.training.policy.goals import GRASP_UNIT_M, PLACE_UNIT_M
from tableverse_factory.evaluation.training.policy.losses import compute_chunk_losses, compute_flow_loss
from tableverse_factory.evaluation.training.policy.network import make_network
from tableverse_factory.evaluation.training.policy.picture_goals import GRASP, UNIT_M, encode_pose, make_picture_network
from tableverse_factory.evaluation.training.policy.samples import draw_chunks, draw_goals, draw_rows
from tableverse_factory.evaluation.training.policy.settings import PolicySettings
from tableverse_factory.evaluation.training.policy.tensors import DemonstrationTensors
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()

GAIN, SHADE, NOISE = 0.2, 0.1, 0.02  # of a picture's colours: deviation of factors, of offsets, and of each pixel


class Lesson(Protocol):
    """Lesson of a training."""

    def make_network(self, seed: int) -> Any:
        """Make the networks on the CPU."""

    def compute_losses(self, network: Any, settings: PolicySettings) -> dict[str, Tensor]:
        """Compute the losses of one step on random samples."""

    def measure(self, network: Any, held_out: bool) -> dict[str, float]:
        """Measure the averaged network on random demonstrations."""


class StateLesson:
    """Goals and motions from states."""

    def __init__(self, data: DemonstrationTensors) -> None:
        self._data = data

    def make_network(self, seed: int) -> Any:
        """Make the networks on the CPU."""
        return make_network(seed)

    def compute_losses(self, network: Any, settings: PolicySettings) -> dict[str, Tensor]:
        """Compute the losses of one step on random samples."""
        with torch.no_grad():
            goals = draw_goals(self._data, settings.goals, held_out=False, augment=True)
            chunks = draw_chunks(self._data, settings.chunks, held_out=False, augment=True)
        with _autocast(chunks.state):
            memory = network.goal.encode(goals.points, goals.roles, goals.mask, goals.task)
            flow = compute_flow_loss(network.goal, memory, goals.goal, settings.flows)
            return {"flow": flow, **compute_chunk_losses(network.motion, chunks)}

    def measure(self, network: Any, held_out: bool) -> dict[str, float]:
        """Measure goals, and the losses of motions."""
        with torch.no_grad():
            goals = draw_goals(self._data, validate.GOALS, held_out, augment=False)
            memory = network.goal.encode(goals.points, goals.roles, goals.mask, goals.task)
            losses = compute_chunk_losses(network.motion, draw_chunks(self._data, validate.CHUNKS, held_out, False))
        units = GRASP_UNIT_M, PLACE_UNIT_M
        figures = {name: float(each) for name, each in losses.items()}
        return figures | validate.measure_goals(network.goal, memory, goals.goal, goals.release, units)


class PictureLesson:
    """Goals from first pictures; motions are those of a policy on states and stay as they are."""

    def __init__(self, data: DemonstrationTensors, pictures: Tensor, words: Tensor, motion: dict[str, Tensor]) -> None:
        """Take pictures, uint8 of shape (n, cameras, 3, h, w), words, (n, wordings, k), and weights of motions."""
        self._data, self._pictures, self._words, self._motion = data, pictures, words, motion

    def make_network(self, seed: int) -> Any:
        """Make the networks on the CPU."""
        network = make_picture_network(seed)
        network.motion.load_state_dict(self._motion)
        return network

    def _draw(self, count: int, held_out: bool, augment: bool) -> tuple[tuple[Tensor, ...], Tensor, Tensor]:
        """Draw what the network is told, goals, and which are releases."""
        data = self._data
        demos = draw_rows(data.choices[held_out][0], count)
        release = torch.rand(count, device=demos.device) < 0.5
        base = data.base_at[demos], data.base_turn[demos]
        opening, holding = data.openings[demos], data.holding[demos]
        grasp = encode_pose(base, (data.grasp_at[demos], data.grasp_turn[demos]), opening[:, 0], holding)
        place = encode_pose(base, (data.place_at[demos], data.place_turn[demos]), opening[:, 1], holding)
        pictures = self._pictures[demos].float() / 255
        wording = torch.randint(self._words.shape[1], (count,), device=demos.device) * augment
        if augment:
            shape = (count, pictures.shape[1], 3, 1, 1)
            gain = torch.exp(GAIN * torch.randn(shape, device=demos.device))
            pictures = pictures * gain + SHADE * torch.randn(shape, device=demos.device)
            pictures = (pictures + NOISE * torch.randn_like(pictures)).clamp(0.0, 1.0)
        told = pictures, self._words[demos, wording], release, grasp[:, :GRASP]
        return told, torch.where(release[:, None], place, grasp), release

    def compute_losses(self, network: Any, settings: PolicySettings) -> dict[str, Tensor]:
        """Compute the loss of one step on random samples."""
        with torch.no_grad():
            told, goal, _ = self._draw(settings.goals, held_out=False, augment=True)
        with _autocast(goal):
            memory = network.goal.encode(*told)
            return {"flow": compute_flow_loss(network.goal, memory, goal, settings.flows)}

    def measure(self, network: Any, held_out: bool) -> dict[str, float]:
        """Measure goals."""
        with torch.no_grad():
            told, goal, release = self._draw(validate.GOALS, held_out, augment=False)
            memory = network.goal.encode(*told)
        return validate.measure_goals(network.goal, memory, goal, release, (UNIT_M, UNIT_M))


def _autocast(like: Tensor) -> Any:
    """Compute in bfloat16 on a GPU."""
    return torch.autocast(like.device.type, torch.bfloat16, enabled=like.device.type == "cuda")
