"""How many scenes each stage let through."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from tableverse_factory.viz.overview.gather import OverviewLoss


@dataclass(frozen=True, slots=True)
class FunnelStep:
    """A stage: the scenes that left it, and those that it dropped or that failed in it."""

    stage: str
    left: int
    dropped: int
    failed: int


def funnel(entered: int, losses: Sequence[OverviewLoss], stages: Sequence[str]) -> tuple[FunnelStep, ...]:
    """Step by step, in the order of the stages; stages that lost scenes and are not listed come first."""
    lost = Counter[tuple[str, str]]()
    for loss in losses:
        lost[loss.stage, loss.status] += loss.count
    strangers = sorted({stage for stage, _ in lost} - set(stages))
    steps, left = [], entered
    for stage in (*strangers, *stages):
        dropped, failed = lost[stage, "dropped"], lost[stage, "failed"]
        left -= sum(count for (where, _), count in lost.items() if where == stage)
        steps.append(FunnelStep(stage, left, dropped, failed))
    return tuple(steps)
