"""What the process in a sandbox says: of every stage that ended, with one byte in front that tells what it is.

That a stage is done is said for every stage of every scene, so it is a few numbers and no record.
"""

import struct
from dataclasses import astuple, dataclass

from schemas.codec import decode, encode
from schemas.outcome import Failed, Spent
from schemas.work import StageReport

_DONE, _REPORT, _BROKEN, _NO_INPUT = b"d", b"r", b"b", b"n"
_NUMBERS = struct.Struct("<3d")
_SPENT = struct.Struct("<qqqdqqqd")


@dataclass(frozen=True, slots=True)
class StageDone:
    """A stage is done.

    Attributes:
        report: Its report.
        cpu_s: CPU time of the process so far [s].
    """

    report: StageReport
    cpu_s: float


@dataclass(frozen=True, slots=True)
class InputMissing:
    """The record that is the input is gone or damaged."""


SandboxMessage = StageDone | StageReport | Failed | InputMissing
"""A stage that is done; one that is not; the process that cannot go on; the chain that cannot begin."""


def encode_message(what: SandboxMessage) -> bytes:
    """As one message."""
    match what:
        case StageDone(report=report, cpu_s=cpu_s):
            spent = _SPENT.pack(*astuple(report.cost), *astuple(report.paid)) if report.cost else b""
            return _DONE + _NUMBERS.pack(report.cpu_s, report.wall_s, cpu_s) + spent
        case StageReport():
            return _REPORT + encode(what)
        case Failed():
            return _BROKEN + encode(what)
        case InputMissing():
            return _NO_INPUT


def decode_message(message: bytes) -> SandboxMessage:
    """The message understood.

    Raises:
        ValueError: if nobody of ours said it.
    """
    kind, rest = message[:1], message[1:]
    if kind == _DONE and len(rest) in (_NUMBERS.size, _NUMBERS.size + _SPENT.size):
        cpu_s, wall_s, total_s = _NUMBERS.unpack_from(rest)
        spent = _SPENT.unpack_from(rest, _NUMBERS.size) if len(rest) > _NUMBERS.size else (0, 0, 0, 0.0) * 2
        return StageDone(StageReport(None, 1, cpu_s, wall_s, "", Spent(*spent[:4]), Spent(*spent[4:])), total_s)
    if kind == _NO_INPUT:
        return InputMissing()
    what = decode(rest)
    if (kind, type(what)) not in ((_REPORT, StageReport), (_BROKEN, Failed)):
        raise ValueError(f"not a message of a sandbox: {message[:20]!r}")
    known: StageReport | Failed = what
    return known
