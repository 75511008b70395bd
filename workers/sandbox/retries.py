"""Progress of a chain of stages over several child processes.

A crash, a hang or too much memory is the scene's own only in a new child that began with this stage. A used one still
holds what earlier stages left in it, and which these were depends on the executor, on the number of workers and on
interruptions: stages of other scenes, or those before it in its chain, which a resumed build begins behind them. A
failure in a used child is therefore repeated in a new one and does not count as an attempt; once is enough, also where
the input was lost meanwhile and the stage before runs again in that child.
"""

from collections import Counter
from dataclasses import dataclass, field, replace

from schemas.outcome import Allowance, Failed
from schemas.work import ScenePart, StageChain, StageChainReport, StageReport

MAX_KILLS = 5  # times that a child may be killed from outside during one chain before the chain fails


@dataclass(slots=True)
class ChildResult:
    """Result of a child for a chain, or for the rest of one."""

    reports: list[StageReport] = field(default_factory=list)  # of the stages that ended
    outputs: list[ScenePart | str] = field(default_factory=list)  # of those that are done (see `StageDone`)
    killed: bool = False  # whether the child was killed from outside
    input_lost: bool = False  # whether the checkpoint that is the input was missing
    new_child: bool = False  # whether the child had run nothing before


class ChainRun:
    """State of a chain between its attempts."""

    def __init__(self, chain: StageChain, attempts: int) -> None:
        self._chain, self._attempts = chain, attempts
        self._done: list[StageReport] = []
        self._outputs: list[ScenePart | str] = []
        self._tries = Counter({number: call.tried for number, call in enumerate(chain.calls)})
        self._losses = chain.losses
        self._failed_in_used = {0} if chain.new_child else set()  # stages
        self._counted = True
        self.rest = chain

    @property
    def needs_new_child(self) -> bool:
        """Whether the rest has to run in a new child, because its first stage failed in a used one."""
        return len(self._done) in self._failed_in_used

    def add_result(self, result: ChildResult) -> StageChainReport | None:
        """Add the result of a child; returns the whole report once there is nothing left to try."""
        self._outputs += result.outputs
        for number, report in enumerate(result.reports):
            report = replace(report, attempts=self._tries[len(self._done)] + 1)
            if report.outcome is None:
                self._done.append(report)
            elif not may_retry(report):
                return self._make_report(report)
            elif (result.new_child and number == 0) or self.needs_new_child:
                self._tries[len(self._done)] += 1
                if report.attempts >= self._attempts:
                    return self._make_report(report)
            else:
                self._failed_in_used.add(len(self._done))
        if len(self._done) == len(self._chain.calls):
            return self._make_report()
        if result.killed:
            self._losses, self._counted = self._losses + 1, False
            if self._losses >= MAX_KILLS:
                text = f"its process was killed from outside {self._losses} times: is this machine out of memory?"
                return self._make_report(StageReport(Failed("lost", text), 1, 0.0, 0.0))
        if result.input_lost and not self._done:
            return replace(self._make_report(), input_lost=True)
        if result.input_lost:  # the output of a finished stage is lost: run it again
            self._done.pop()
            self._outputs.pop()
        self._advance()
        return None

    def _make_report(self, *last: StageReport) -> StageChainReport:
        output, counted = self._outputs[-1] if self._outputs else "", self._counted and not any(map(may_retry, last))
        reports = (*self._done, *last)
        return StageChainReport(
            reports, output, losses=self._losses, counted=counted, new_child=bool(last) and self.needs_new_child
        )

    def _advance(self) -> None:
        """Set the rest of the chain to begin behind the last finished stage, whose checkpoint is the input."""
        self._counted = False
        count = len(self._done)
        # What a dead process spent is unknown here: the driver reads the cost log before it grants more.
        granted = self._chain.allowance
        self.rest = replace(
            self._chain,
            position=self._chain.position + count,
            calls=self._chain.calls[count:],
            input=str(self._outputs[-1]) if count else self._chain.input,
            allowance=Allowance(0, 0.0, granted.name) if granted.is_limited else granted,
        )


def may_retry(report: StageReport) -> bool:
    """Whether another process may succeed; an exception would recur for the same input."""
    return isinstance(report.outcome, Failed) and report.outcome.error_kind in ("crash", "timeout", "out_of_memory")
