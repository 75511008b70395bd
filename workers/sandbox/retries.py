"""How far a chain of stages has come, over as many children as it took."""

from collections import Counter
from dataclasses import dataclass, field, replace

from schemas.outcome import Allowance, Failed
from schemas.work import StageChain, StageChainReport, StageReport

MAX_LOSSES = 3
"""How often a child may be killed from outside during one chain before the chain is given up."""


@dataclass(slots=True)
class ChildResult:
    """What came back from a child for a chain, or for the rest of one.

    Attributes:
        reports: Of the stages that ended.
        value: The output of the last one, if all are done.
        killed: Whether the child was killed from outside.
        input_lost: Whether the record that is the input was not there.
    """

    reports: list[StageReport] = field(default_factory=list)
    value: bytes = b""
    killed: bool = False
    input_lost: bool = False


class ChainRun:
    """How far a chain has come, over several children."""

    def __init__(self, chain: StageChain, attempts: int) -> None:
        self._chain, self._attempts = chain, attempts
        self._done: list[StageReport] = []
        self._tries = Counter({number: call.tried for number, call in enumerate(chain.calls)})
        self._losses = chain.losses
        self._counted = True
        self.rest = chain

    def take(self, heard: ChildResult) -> StageChainReport | None:
        """Takes in what a child said; the whole report once there is nothing left to try."""
        for report in heard.reports:
            self._tries[len(self._done)] += 1
            report = replace(report, attempts=self._tries[len(self._done)])
            if report.outcome is None:
                self._done.append(report)
            elif not may_retry(report) or report.attempts >= self._attempts:
                return self._ended(report)
        if len(self._done) == len(self._chain.calls):
            return self._ended()
        if heard.killed:
            self._losses, self._counted = self._losses + 1, False
            if self._losses >= MAX_LOSSES:
                text = f"its process was killed from outside {self._losses} times: is this machine out of memory?"
                return self._ended(StageReport(Failed("lost", text), 1, 0.0, 0.0))
        if heard.input_lost and not self._done:
            return replace(self._ended(), input_lost=True)
        if heard.input_lost:  # of a stage that was done: it is done again
            self._done.pop()
        self._go_on()
        return None

    def _ended(self, *last: StageReport) -> StageChainReport:
        return StageChainReport(
            (*self._done, *last), losses=self._losses, counted=self._counted and not any(map(may_retry, last))
        )

    def _go_on(self) -> None:
        """The rest begins behind the last stage that is done and kept."""
        self._counted = False
        while self._done and not self._chain.output_records[len(self._done) - 1]:
            self._done.pop()
        count = len(self._done)
        record = self._chain.output_records[count - 1] if count else self._chain.input_record
        # Nobody knows what a process spent that is gone: before more is, the driver looks at what was written down.
        granted = self._chain.allowance
        allowance = Allowance(0, 0.0, granted.name) if granted.is_limited else granted
        self.rest = StageChain(self._chain.calls[count:], record, self._chain.output_records[count:], allowance)


def may_retry(report: StageReport) -> bool:
    """Whether the process is to blame and another one may succeed; an exception comes again for the same input."""
    return isinstance(report.outcome, Failed) and report.outcome.error_kind in ("crash", "timeout", "out_of_memory")
