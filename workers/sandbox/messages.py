"""Messages of the process in a sandbox: one for every stage that ended, with a byte in front that tells its kind.

A finished stage is reported for every stage of every scene, so it is a short list of numbers and not a record.
"""

import json
from dataclasses import astuple, dataclass
from typing import Any

from schemas.codec import decode, encode
from schemas.outcome import NO_COST, Failed, ModelCost
from schemas.work import ScenePart, StageReport

_DONE, _REPORT, _BROKEN, _NO_INPUT = b"d", b"r", b"b", b"n"
_PART = [str, int, int, int]  # types of the fields of a `ScenePart`
_N_NUMBERS = 3 + 2 * len(astuple(NO_COST))


@dataclass(frozen=True, slots=True)
class StageDone:
    """A stage is done."""

    report: StageReport
    cpu_s: float  # CPU time of the process so far [s]
    output: ScenePart | str  # the finished scene, or the location of the stage's checkpoint


@dataclass(frozen=True, slots=True)
class InputMissing:
    """The checkpoint that is the input is gone or damaged."""


SandboxMessage = StageDone | StageReport | Failed | InputMissing
"""A finished stage; one that is not done; a process that cannot go on; a chain that cannot start."""


def encode_message(message: SandboxMessage) -> bytes:
    """Encode a message as bytes."""
    match message:
        case StageDone(report=report, cpu_s=cpu_s, output=output):
            costs = (
                (0, 0, 0, 0.0) * 2
                if not (report.cost or report.paid)
                else (*astuple(report.cost), *astuple(report.paid))
            )
            place = output if isinstance(output, str) else astuple(output)
            numbers = (report.cpu_s, report.wall_s, cpu_s, *costs)
            return _DONE + json.dumps((*numbers, place)).encode()
        case StageReport():
            return _REPORT + encode(message)
        case Failed():
            return _BROKEN + encode(message)
        case InputMissing():
            return _NO_INPUT


def decode_message(data: bytes) -> SandboxMessage:
    """Decode a message."""
    kind, rest = data[:1], data[1:]
    if kind == _NO_INPUT:
        return InputMissing()
    if kind == _DONE:
        values: Any = json.loads(rest)
        numbers: list[Any] = values[:-1] if isinstance(values, list) else []
        place: Any = values[-1] if numbers else None
        is_place = isinstance(place, str) or (isinstance(place, list) and [type(v) for v in place] == _PART)
        if is_place and len(numbers) == _N_NUMBERS and {type(n) for n in numbers} <= {int, float}:
            cost, paid = ModelCost(*numbers[3:7]), ModelCost(*numbers[7:])
            report = StageReport(None, 1, numbers[0], numbers[1], "", cost, paid)
            return StageDone(report, numbers[2], place if isinstance(place, str) else ScenePart(*place))
    elif kind in (_REPORT, _BROKEN):
        message = decode(rest)
        if isinstance(message, StageReport if kind == _REPORT else Failed):
            return message
    raise ValueError(f"not a message of a sandbox: {data[:20]!r}")
