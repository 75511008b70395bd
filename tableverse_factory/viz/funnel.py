"""Funnel of a dataset: how many scenes each stage let through, and why it lost the others."""

from collections import defaultdict
from collections.abc import Collection, Iterable
from dataclasses import dataclass

from tableverse_factory import pipeline


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


def compute_funnel(entered: int, losses: Iterable[SceneLoss], kinds: Collection[str]) -> tuple[FunnelStep, ...]:
    """Compute the steps of scenes of these kinds; stages that lost scenes and are in no pipeline come first."""
    by_stage: dict[str, list[SceneLoss]] = defaultdict(list)
    for loss in losses:
        by_stage[loss.stage].append(loss)
    stages = _list_stages(kinds)
    left, steps = entered, []
    for stage in (*sorted(set(by_stage) - set(stages)), *stages):
        left -= sum(loss.count for loss in by_stage[stage])
        steps.append(FunnelStep(stage, left, tuple(by_stage[stage])))
    return tuple(steps)


def _list_stages(kinds: Collection[str]) -> tuple[str, ...]:
    """List the stages that scenes of these kinds run through, in order: first those that not all kinds have."""
    pipelines = [stages for kind, stages in pipeline.PIPELINES.items() if kind.value in kinds] or [pipeline.STAGES]
    shared = [stage.name for stage in pipelines[0] if all(stage in stages for stages in pipelines)]
    own = [stage.name for stages in pipelines for stage in stages if stage.name not in shared]
    return (*dict.fromkeys(own), *shared)
