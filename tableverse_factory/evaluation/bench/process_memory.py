"""Resident memory of processes over their lives, sampled from outside, and how much of it they gain late."""

import math
import time
from array import array
from dataclasses import dataclass, field
from statistics import median

import psutil

MIN_LIFE_S = 180.0  # a younger process still loads what it needs
_MB = 1_000_000


@dataclass(frozen=True, slots=True)
class KindMemory:
    """Memory of the processes of one kind."""

    kind: str
    processes: int
    peak_mb: float
    long_lived: int  # of them, those that lived long enough to tell their growth
    growth: float  # largest share that one of these gained over the second half of its life; nan for none


@dataclass(slots=True)
class _Life:
    kind: str
    at_s: "array[float]" = field(default_factory=lambda: array("d"))
    mb: "array[float]" = field(default_factory=lambda: array("d"))


class MemoryLog:
    """Log of the memory of processes, each known by its number and the time of its start."""

    def __init__(self, min_life_s: float = MIN_LIFE_S) -> None:
        """Growth is that of processes seen for `min_life_s`."""
        self._min_life_s = min_life_s
        self._lives: dict[tuple[int, float], _Life] = {}

    def sample(self, kind: str, process: psutil.Process) -> None:
        """Add the present memory of a process; nothing if it has ended."""
        try:
            key, mb = (process.pid, process.create_time()), process.memory_info().rss / _MB
        except psutil.NoSuchProcess:
            return
        if mb:  # a process that is ending has none
            self.add(kind, key, time.monotonic(), mb)

    def add(self, kind: str, key: tuple[int, float], at_s: float, mb: float) -> None:
        """Add a sample: the time of the monotonic clock [s] and the memory [MB]."""
        life = self._lives.setdefault(key, _Life(kind))
        life.at_s.append(at_s)
        life.mb.append(mb)

    def summarize(self) -> tuple[KindMemory, ...]:
        """Summarize the processes of each kind."""
        summaries = []
        for kind in sorted({life.kind for life in self._lives.values()}):
            lives = [life for life in self._lives.values() if life.kind == kind]
            grown = [compute_growth(life.at_s, life.mb) for life in lives if self._is_long(life)]
            peak_mb = max(max(life.mb) for life in lives)
            summaries.append(KindMemory(kind, len(lives), peak_mb, len(grown), max(grown, default=math.nan)))
        return tuple(summaries)

    def _is_long(self, life: _Life) -> bool:
        return life.at_s[-1] - life.at_s[0] >= self._min_life_s


def compute_growth(at_s: "array[float]", mb: "array[float]") -> float:
    """Compute the share that memory gains over the second half: medians of its last quarter and of its first."""
    half_s = (at_s[0] + at_s[-1]) / 2
    late = [value for seconds, value in zip(at_s, mb, strict=True) if seconds >= half_s]
    quarter = max(1, len(late) // 4)
    return median(late[-quarter:]) / median(late[:quarter]) - 1.0
