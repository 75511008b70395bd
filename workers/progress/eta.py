"""Rate and remaining time of a build, estimated from its recent past: arithmetic on tallies, without a clock."""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass

from workers.progress.tally import Tally

RATE_WINDOW_S = 60.0
WORK_WINDOW_S = 300.0
LONG_WINDOW_S = 7200.0
SAMPLE_EVERY_S = 1.0
LONG_SAMPLE_EVERY_S = 60.0
_MIN_RATE_S = 5.0
_MIN_SCENES = 5
_MIN_CALLS = 3
_MIN_WORK_S = 10.0


@dataclass(frozen=True, slots=True)
class _Sample:
    at: float
    accounted: int
    calls: Mapping[str, int]


class ProgressRate:
    """Samples of a tally: one per second over five minutes, one per minute over two hours."""

    def __init__(self) -> None:
        self._samples: deque[_Sample] = deque()
        self._rare: deque[_Sample] = deque()
        self._changed = 0.0
        self._calls = -1

    def update(self, now: float, tally: Tally) -> None:
        """Add the tally of the time `now` [s]; sampling starts when a call has ended, since before it models load."""
        calls = {stage: wall.count for stage, wall in tally.wall.items()}
        total = sum(calls.values()) + tally.accounted
        if total != self._calls:
            self._calls, self._changed = total, now
        if total == tally.before or (self._samples and now - self._samples[-1].at < SAMPLE_EVERY_S):
            return
        sample = _Sample(now, tally.accounted, calls)
        self._samples.append(sample)
        if not self._rare or now - self._rare[-1].at >= LONG_SAMPLE_EVERY_S:
            self._rare.append(sample)
        for samples, window_s in ((self._samples, WORK_WINDOW_S), (self._rare, LONG_WINDOW_S)):
            while samples[0].at < now - window_s:
                samples.popleft()

    def idle_s(self, now: float) -> float:
        """Compute the time since the last call ended [s]."""
        return now - self._changed

    def scenes_per_s(self, now: float, tally: Tally) -> float | None:
        """Compute the scenes accounted for per second over the last minute; None if it is too early."""
        past = self._past(now, RATE_WINDOW_S, _MIN_RATE_S)
        return None if past is None else (tally.accounted - past.accounted) / (now - past.at)

    def calls_per_s(self, now: float, tally: Tally, stage: str) -> float | None:
        """Compute the scenes through a stage per second over the last minute; None if it is too early."""
        past = self._past(now, RATE_WINDOW_S, _MIN_RATE_S)
        if past is None or stage not in tally.wall:
            return None
        return (tally.wall[stage].count - past.calls.get(stage, 0)) / (now - past.at)

    def estimate_left_s(self, now: float, tally: Tally) -> float | None:
        """Estimate the remaining time [s]; None if too little is known.

        The remaining work is the sum over all stages of the remaining calls times their mean wall time. It is divided
        by the work per second of the last five minutes, or of as long as it takes for five scenes to end. So neither
        the start of a build nor early drops mislead the estimate.
        """
        past = self._past_of_scenes(now, tally.accounted)
        if past is None:
            return None
        mean_s = {stage: wall.mean_s for stage, wall in tally.wall.items()}
        to_come = estimate_remaining_calls(tally)
        if any(
            calls > 0.5 and (stage not in mean_s or tally.wall[stage].count < _MIN_CALLS)
            for stage, calls in to_come.items()
        ):
            return None
        done_s = sum((wall.count - past.calls.get(stage, 0)) * mean_s[stage] for stage, wall in tally.wall.items())
        if done_s <= 0.0:
            return None
        left_s = sum(calls * mean_s[stage] for stage, calls in to_come.items() if stage in mean_s)
        return left_s / done_s * (now - past.at)

    def _past_of_scenes(self, now: float, accounted: int) -> _Sample | None:
        """Find the oldest sample of the last five minutes, or the latest since which enough scenes have ended."""
        past = self._past(now, WORK_WINDOW_S, _MIN_WORK_S)
        for sample in (past, *reversed(self._rare)):
            if sample is not None and accounted - sample.accounted >= _MIN_SCENES and now - sample.at >= _MIN_WORK_S:
                return sample
        return None

    def _past(self, now: float, window_s: float, least_s: float) -> _Sample | None:
        """Find the oldest sample within the window; None if it is younger than `least_s`."""
        for sample in self._samples:
            if sample.at >= now - window_s:
                return sample if now - sample.at >= least_s else None
        return None


def estimate_remaining_calls(tally: Tally) -> dict[str, float]:
    """Estimate the remaining calls of each stage if the remaining scenes fare as those so far.

    A scene in flight reaches the next stage with the share of those that passed; one that has not entered yet
    enters at a stage as often as the earlier ones entered there.
    """
    own = tally.stages[1:]  # the first is the manifest, which costs nothing
    ended = {stage: sum(n for (at, _), n in tally.ended.items() if at == stage) for stage in tally.stages}
    inside = {stage: tally.queued[stage] + tally.running[stage] for stage in own}
    entered = sum(ended[stage] for stage in own) + sum(inside.values())
    rejected = ended[tally.stages[0]] if tally.stages else 0
    outside = tally.left - sum(inside.values())
    to_enter = outside * entered / (entered + rejected) if entered else 0.0
    to_come: dict[str, float] = {}
    passed_before, flow = 0, 0.0
    for stage in own:
        arrived = tally.passed[stage] + ended[stage] + inside[stage]
        entering = to_enter * max(0, arrived - passed_before) / max(entered, 1)
        to_come[stage] = flow + entering + inside[stage]
        answered = tally.passed[stage] + ended[stage]
        flow = to_come[stage] * tally.passed[stage] / answered if answered else to_come[stage]
        passed_before = tally.passed[stage]
    return to_come
