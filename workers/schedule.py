"""Who works on what: frozen arithmetic over counts, without clocks, processes or Ray."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Ready:
    """A scene inside the line that waits for its next stage.

    Attributes:
        rank: Its rank in the plan.
        pool: Which workers can run the stage.
        left: Stages left, this one included.
    """

    rank: int
    pool: str
    left: int


@dataclass(frozen=True, slots=True)
class Limits:
    """What the schedule may not exceed.

    Attributes:
        calls: Calls in flight at once, over all pools.
        workers: Workers of each pool.
        line: Scenes inside the line at once, which bounds what is held in memory.
    """

    calls: int
    workers: Mapping[str, int]
    line: int


@dataclass(frozen=True, slots=True)
class Assignment:
    """A scene's next stage for a worker; None asks for a new worker of that pool."""

    rank: int
    pool: str
    worker: int | None


def limits_for(calls: int, workers: Mapping[str, int]) -> Limits:
    """Limits of a build with so many calls in flight: as many scenes again may wait between two stages."""
    return Limits(calls, workers, line=2 * calls)


def admit(in_line: int, limits: Limits) -> int:
    """How many scenes may enter the line."""
    return max(0, limits.line - in_line)


def assign(
    ready: Sequence[Ready], idle: Mapping[str, Sequence[int]], alive: Mapping[str, int], in_flight: int, limits: Limits
) -> tuple[Assignment, ...]:
    """The next calls: scenes near the end of the line first, then in the plan's order.

    Finishing before beginning is the back-pressure: a stage whose successors are busy gets nothing to do, so what
    waits between stages stays small. A pool grows by one worker when a scene waits for it and none of it is idle.

    Args:
        ready: Scenes that wait.
        idle: Idle workers of each pool.
        alive: Workers of each pool, idle or busy.
        in_flight: Calls under way.
        limits: What may not be exceeded.
    """
    free = limits.calls - in_flight
    left = {pool: sorted(workers) for pool, workers in idle.items()}
    count = dict(alive)
    chosen: list[Assignment] = []
    for scene in sorted(ready, key=lambda scene: (scene.left, scene.rank)):
        if len(chosen) >= free:
            break
        if left.get(scene.pool):
            chosen.append(Assignment(scene.rank, scene.pool, left[scene.pool].pop(0)))
        elif count.get(scene.pool, 0) < limits.workers.get(scene.pool, 0):
            count[scene.pool] = count.get(scene.pool, 0) + 1
            chosen.append(Assignment(scene.rank, scene.pool, None))
    return tuple(chosen)
