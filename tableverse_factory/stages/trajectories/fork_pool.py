"""Work in a forked process, an item at a time: what crashes, hangs or eats memory costs that item alone.

A child works through the items and hands each answer back as bytes. When it dies, or is killed for taking too long or
too much, the item that it was at is lost; a new child, forked from the same untouched parent, goes on behind it.
Errors that no item is to blame for are raised again in the parent, as what they were.
"""

import ctypes
import faulthandler
import os
import resource
import select
import signal
import struct
import time
import warnings
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import psutil

from tableverse_factory.core.errors import ConfigError, ModelAccessError, ModelError, StoreError, TableverseError

_DONE, _RAISED, _FOR_ALL = b"d", b"r", b"a"
_HEADER = struct.Struct("<cQ")
_PR_SET_PDEATHSIG = 1
_LOOK_S = 0.2
_MAX_ANSWER = 1 << 30
_MAX_WORDS = 500
_OF_ALL: dict[str, type[TableverseError]] = {
    kind.__name__: kind for kind in (ConfigError, ModelAccessError, ModelError, StoreError)
}
"""What would come again for every item, by name; an answer of a model that is none (`AnswerInvalidError`) would not."""


@dataclass(frozen=True, slots=True)
class ItemFailure:
    """An item without an answer.

    Attributes:
        kind: `exception`, `crash`, `timeout` or `out_of_memory`.
        detail: One line for people.
    """

    kind: Literal["exception", "crash", "timeout", "out_of_memory"]
    detail: str


def map_in_fork(
    work: Callable[[int], bytes], count: int, deadline_s: float, memory_mb: float
) -> tuple[bytes | ItemFailure, ...]:
    """The answers to the items 0 to `count` - 1, in order.

    Args:
        work: Gives the answer to an item. What it keeps for itself lives as long as its process, so no answer may
            depend on what is kept. What it raises costs the item alone, but for the errors below.
        count: How many items there are.
        deadline_s: Wall time of one item [s].
        memory_mb: Resident memory of the process [MB].

    Raises:
        ConfigError: if `work` raises it; so the others.
        ModelAccessError: if a person must act.
        ModelError: if a model does not answer.
        StoreError: if a store does not.
    """
    answers: list[bytes | ItemFailure] = []
    while len(answers) < count:
        answers += _one_child(work, range(len(answers), count), deadline_s, memory_mb)
    return tuple(answers)


def _one_child(
    work: Callable[[int], bytes], items: range, deadline_s: float, memory_mb: float
) -> list[bytes | ItemFailure]:
    """What one child gave; the last is what it perished of, where it did not reach the end."""
    child = _Child(work, items, deadline_s, memory_mb)
    answers: list[bytes | ItemFailure] = []
    try:
        while len(answers) < len(items):
            answers.append(child.answer())
            if isinstance(answers[-1], ItemFailure) and answers[-1].kind != "exception":
                break
    finally:
        child.end()
    return answers


class _Child:
    """A forked process that works through items; killed where it takes too long or too much."""

    def __init__(self, work: Callable[[int], bytes], items: range, deadline_s: float, memory_mb: float) -> None:
        self._deadline_s, self._memory_mb = deadline_s, memory_mb
        self._reading, writing = os.pipe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of threads beside a fork: the child starts none
            self._pid = os.fork()
        if self._pid == 0:
            os.close(self._reading)
            _serve(work, items, writing)
        os.close(writing)
        self._process = psutil.Process(self._pid)

    def answer(self) -> bytes | ItemFailure:
        """The answer to the next item.

        Raises:
            TableverseError: as `map_in_fork`.
        """
        until = time.monotonic() + self._deadline_s
        head = self._read(_HEADER.size, until)
        if isinstance(head, ItemFailure):
            return head
        kind, size = _HEADER.unpack(head)
        if size > _MAX_ANSWER:
            return ItemFailure("crash", f"its process answered with nonsense ({size} bytes)")
        body = self._read(size, until)
        if isinstance(body, ItemFailure) or kind == _DONE:
            return body
        if kind == _FOR_ALL:
            name, _, message = body.decode(errors="replace").partition(" ")
            raise _OF_ALL[name](message)
        return ItemFailure("exception", body.decode(errors="replace"))

    def end(self) -> None:
        """Ends the process, if it has not ended by itself."""
        os.close(self._reading)
        with suppress(psutil.NoSuchProcess):
            self._process.kill()
        self._process.wait()

    def _read(self, size: int, until: float) -> bytes | ItemFailure:
        parts = bytearray()
        while len(parts) < size:
            if time.monotonic() > until:
                return ItemFailure("timeout", f"took longer than {self._deadline_s:g} s")
            if (taken := self._resident_mb()) > self._memory_mb:
                return ItemFailure("out_of_memory", f"took {taken:.0f} MB, more than {self._memory_mb:.0f}")
            if not select.select([self._reading], [], [], _LOOK_S)[0]:
                continue
            part = os.read(self._reading, min(size - len(parts), 1 << 20))
            if not part:
                return ItemFailure("crash", f"its process {self._end_in_words()}")
            parts += part
        return bytes(parts)

    def _resident_mb(self) -> float:
        try:
            return float(self._process.memory_info().rss) / 1e6
        except psutil.Error:  # it has just ended: the pipe says so
            return 0.0

    def _end_in_words(self) -> str:
        code = self._process.wait()
        return f"was killed by {signal.Signals(-code).name}" if code is not None and code < 0 else f"ended with {code}"


def _serve(work: Callable[[int], bytes], items: range, writing: int) -> None:
    """Answers the items in the child, which never returns from here."""
    status = 1
    try:
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for the parent, whose end is the child's
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        faulthandler.disable()  # how it ended is an answer, not a trace on somebody's terminal
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for item in items:
            try:
                kind, body = _DONE, work(item)
            except Exception as error:  # noqa: BLE001 every error is the item's answer
                kind, body = _said(error)
            _write(writing, _HEADER.pack(kind, len(body)) + body)
        status = 0
    finally:
        os._exit(status)  # nothing of the parent's may run its end in here


def _said(error: Exception) -> tuple[bytes, bytes]:
    """How an error travels, in one bounded line."""
    name, words = type(error).__name__, " ".join(str(error).split())
    if _OF_ALL.get(name) is type(error):
        return _FOR_ALL, f"{name} {words[:_MAX_WORDS]}".encode(errors="replace")
    return _RAISED, f"{name}: {words}"[:_MAX_WORDS].encode(errors="replace")


def _write(descriptor: int, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[os.write(descriptor, view) :]
