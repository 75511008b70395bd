"""Lessons: what a training makes, the losses of a step, and figures of what was learnt."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Protocol

from tableverse_factory.evaluation.training.policy import validate
from tableverse_factory.evaluation.training.policy.goals import GRASP_UNIT_M, PLACE_UNIT_M
from tableverse_factory.evaluation.training.policy.losses import compute_chunk_losses, compute_flow_loss
from tableverse_factory.evaluation.training.policy.network import make_network
from tableverse_factory.evaluation.training.policy.samples import draw_chunks, draw_goals
from tableverse_factory.evaluation.training.policy.settings import PolicySettings
from tableverse_factory.evaluation.training.policy.tensors import DemonstrationTensors
from tableverse_factory.models.local.device import Tensor, import_torch

torch = import_torch()


class Lesson(Protocol):
    """Lesson of a training; `rate_factors` scale the learning rate by part of the network, 1 for others."""

    rate_factors: Mapping[str, float]

    def make_network(self, seed: int) -> Any:
        """Make the networks on the CPU."""

    def compute_losses(self, network: Any, settings: PolicySettings) -> dict[str, Tensor]:
        """Compute the losses of one step on random samples."""

    def measure(self, network: Any, held_out: bool) -> dict[str, float]:
        """Measure the averaged network on random demonstrations."""


class StateLesson:
    """Goals and motions from states."""

    rate_factors: Mapping[str, float] = MappingProxyType({})

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
        with autocast(chunks.state):
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


def autocast(like: Tensor) -> Any:
    """Compute in bfloat16 on a GPU."""
    return torch.autocast(like.device.type, torch.bfloat16, enabled=like.device.type == "cuda")
