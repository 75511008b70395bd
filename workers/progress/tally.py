"""Counts of a running build: written by the driver, shown by displays, exported as metrics."""

from bisect import bisect_left
from collections import Counter, defaultdict
from contextlib import AbstractContextManager, ExitStack
from dataclasses import dataclass, field
from types import TracebackType
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from schemas.work import Status

_STEPS = (1.0, 1.25, 1.6, 2.0, 2.5, 3.15, 4.0, 5.0, 6.3, 8.0)
# upper bounds of the buckets of a duration [s]: ten per decade (Renard series R10), from 1 ms to 8,000 s
BOUNDS_S = tuple(float(f"{step}e{power}") for power in range(-3, 4) for step in _STEPS)


class Actors(NamedTuple):
    """Workers of one pool: present ones, including those that start, and the target of the schedule."""

    alive: int
    target: int


@dataclass(slots=True)
class Durations:
    """Histogram of the durations of calls; bucket i ends with `BOUNDS_S[i]`, the last one has no end."""

    buckets: list[int] = field(default_factory=lambda: [0] * (len(BOUNDS_S) + 1))
    total_s: float = 0.0  # sum of all durations [s]

    def add(self, seconds: float) -> None:
        """Count one call."""
        self.buckets[bisect_left(BOUNDS_S, seconds)] += 1
        self.total_s += seconds

    def add_all(self, seconds: NDArray[np.float64]) -> None:
        """Count many calls."""
        counts = np.bincount(np.searchsorted(BOUNDS_S, seconds), minlength=len(self.buckets))
        self.buckets = [before + here for before, here in zip(self.buckets, counts.tolist(), strict=True)]
        self.total_s += float(seconds.sum())

    @property
    def count(self) -> int:
        """Number of calls."""
        return sum(self.buckets)

    @property
    def mean_s(self) -> float:
        """Mean duration [s]; 0 without calls."""
        return self.total_s / self.count if self.count else 0.0

    def quantile(self, q: float) -> float:
        """Compute the `q` quantile [s], within a bucket's width (28 %); 0 without calls.

        Calls are assumed to lie evenly in their bucket; beyond the last bound the result is that bound.
        """
        wanted, before = q * self.count, 0
        for number, here in enumerate(self.buckets):
            if here and before + here >= wanted:
                low = BOUNDS_S[number - 1] if number else 0.0
                high = BOUNDS_S[min(number, len(BOUNDS_S) - 1)]
                return low + (high - low) * max(0.0, wanted - before) / here
            before += here
        return 0.0


@dataclass(slots=True)
class Tally:
    """Counts of a running build; those without another word are of this run."""

    stages: tuple[str, ...]  # in the order of the pipelines
    total: int  # scenes of the plan
    before: int  # scenes that were accounted for at the start of this run
    shards: int  # of the plan
    target: int | None = None  # scenes that will be accounted for when this run ends; None for all of the plan
    committed: int = 0  # shards that are whole
    bytes_committed: int = 0  # bytes of the shards that this run committed
    losses: int = 0  # lost workers and inputs of this run
    restarts: int = 0  # workers started in place of a lost or recycled one
    postponed: int = 0  # scenes left for a later run because a model did not answer
    queued: Counter[str] = field(default_factory=Counter)  # waiting scenes, by their next stage
    running: Counter[str] = field(default_factory=Counter)  # calls in flight, by their first stage of several
    passed: Counter[str] = field(default_factory=Counter)  # scenes that passed a stage, by stage
    ended: Counter[tuple[str, Status]] = field(default_factory=Counter)  # scenes, by stage and status
    actors: dict[str, Actors] = field(default_factory=dict)  # workers by pool
    wall: defaultdict[str, Durations] = field(default_factory=lambda: defaultdict(Durations))  # of calls, by stage
    cpu: defaultdict[str, Durations] = field(default_factory=lambda: defaultdict(Durations))

    def record_call(self, stage: str, cpu_s: float, wall_s: float) -> None:
        """Count the durations of one call of a stage [s]."""
        self.cpu[stage].add(cpu_s)
        self.wall[stage].add(wall_s)

    def count(self, status: Status) -> int:
        """Count the scenes of this run with this outcome."""
        return sum(number for (_, ended), number in self.ended.items() if ended == status)

    @property
    def left(self) -> int:
        """Scenes left for this run."""
        return (self.total if self.target is None else self.target) - self.accounted

    @property
    def accounted(self) -> int:
        """Scenes that are accounted for, in this run and before."""
        return self.before + sum(self.ended.values())


class Display(Protocol):
    """Display of a tally; it is called often and decides when to draw."""

    def show(self, tally: Tally) -> None:
        """Show the tally, which may have changed."""

    def note(self, line: str) -> None:
        """Show a line that the user should read."""


class DisplayGroup:
    """Several displays as one, which enters and leaves them together."""

    def __init__(self, *displays: Display) -> None:
        self._displays = displays
        self._stack = ExitStack()

    def __enter__(self) -> "DisplayGroup":
        with ExitStack() as stack:
            for display in self._displays:
                if isinstance(display, AbstractContextManager):
                    stack.enter_context(display)
            self._stack = stack.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.__exit__(kind, error, trace)

    def show(self, tally: Tally) -> None:
        """Show the tally on all displays."""
        for display in self._displays:
            display.show(tally)

    def note(self, line: str) -> None:
        """Show the line on all displays."""
        for display in self._displays:
            display.note(line)
