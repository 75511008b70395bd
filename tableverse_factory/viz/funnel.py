"""Funnel of a dataset: how many scenes each stage let through, and why it lost the others."""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class SceneLoss:
    """Scenes lost at one stage for one reason; `status` is `dropped` or `failed`."""

    stage: str
    status: str
    reason: str
    count: int


@dataclass(frozen=True, slots=True)
class FunnelStep:
    """A stage: the scenes that left it, and its losses."""

    stage: str
    left: int
    losses: tuple[SceneLoss, ...]

    def count_lost(self, status: str) -> int:
        """Count the scenes that the stage lost with a status."""
        return sum(loss.count for loss in self.losses if loss.status == status)


def compute_funnel(entered: int, losses: Iterable[SceneLoss], stages: Sequence[str]) -> tuple[FunnelStep, ...]:
    """Compute the steps in the order of the stages; stages that lost scenes and are not listed come first."""
    by_stage: dict[str, list[SceneLoss]] = defaultdict(list)
    for loss in losses:
        by_stage[loss.stage].append(loss)
    left, steps = entered, []
    for stage in (*sorted(set(by_stage) - set(stages)), *stages):
        left -= sum(loss.count for loss in by_stage[stage])
        steps.append(FunnelStep(stage, left, tuple(by_stage[stage])))
    return tuple(steps)
