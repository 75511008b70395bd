"""Isolated map over items in a forked process: an item that crashes, hangs or exhausts memory fails alone.

A child works through the items and sends each answer back as bytes. When it dies, or is killed for exceeding its time
or memory, the current item fails and a new child, forked from the same untouched parent, continues with the next one.
Forks share the compiled scene and the robot's reach map, which spawned workers would have to build again.
"""

import faulthandler
import multiprocessing
import os
import resource
import signal
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import ForkProcess
from typing import Literal

import psutil

from tableverse_factory.core.errors import (
    ConfigError,
    ModelAccessError,
    ModelError,
    StoreError,
    TableverseError,
    WeightsError,
)
from tableverse_factory.core.parent_death import die_with_parent

_DONE, _RAISED, _FATAL = b"d", b"r", b"f"
_POLL_S, _EXIT_S = 0.2, 10.0
_MAX_ANSWER, _MAX_MESSAGE = 1 << 30, 500
# Errors that every item would raise again, by exact class name: `AnswerInvalidError` concerns one item only
_FATAL_ERRORS: dict[str, type[TableverseError]] = {
    kind.__name__: kind for kind in (ConfigError, ModelAccessError, ModelError, StoreError, WeightsError)
}


@dataclass(frozen=True, slots=True)
class ItemFailure:
    """Why an item has no answer, with one line for people."""

    kind: Literal["exception", "crash", "timeout", "out_of_memory"]
    detail: str


def map_in_fork(
    work: Callable[[int], bytes], count: int, deadline_s: float, memory_mb: float
) -> tuple[bytes | ItemFailure, ...]:
    """Compute the answers to the items 0 to `count` - 1 in forked processes, each within a wall time and memory.

    Caches of `work` live as long as their process, so no answer may depend on them. An error that `work` raises becomes
    the failure of its item, but a ConfigError, ModelAccessError, ModelError or StoreError is raised here.
    """
    answers: list[bytes | ItemFailure] = []
    while len(answers) < count:
        answers += _run_child(work, range(len(answers), count), deadline_s, memory_mb)
    return tuple(answers)


def _run_child(
    work: Callable[[int], bytes], items: range, deadline_s: float, memory_mb: float
) -> list[bytes | ItemFailure]:
    """Collect answers from one child until all items are done or the child is lost."""
    context = multiprocessing.get_context("fork")
    receiver, sender = context.Pipe(duplex=False)
    child = context.Process(target=_serve, args=(os.getpid(), work, items, sender))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # about threads beside a fork: the child starts none
        child.start()
    sender.close()
    answers: list[bytes | ItemFailure] = []
    try:
        while len(answers) < len(items):
            answers.append(_receive(child, receiver, deadline_s, memory_mb))
            if isinstance(answers[-1], ItemFailure) and answers[-1].kind != "exception":
                break
    finally:
        receiver.close()
        child.kill()
        child.join()
        child.close()
    return answers


def _receive(child: ForkProcess, receiver: Connection, deadline_s: float, memory_mb: float) -> bytes | ItemFailure:
    """Wait for the next answer while watching the child's time and memory."""
    until = time.monotonic() + deadline_s
    while not receiver.poll(_POLL_S):
        if time.monotonic() > until:
            return ItemFailure("timeout", f"took longer than {deadline_s:g} s")
        if (resident_mb := _measure_resident_mb(child)) > memory_mb:
            return ItemFailure("out_of_memory", f"took {resident_mb:.0f} MB, more than {memory_mb:.0f}")
    try:
        message = receiver.recv_bytes(_MAX_ANSWER)
    except (EOFError, OSError):
        child.join(_EXIT_S)
        code = child.exitcode
        end = f"was killed by {signal.Signals(-code).name}" if code is not None and code < 0 else f"ended with {code}"
        return ItemFailure("crash", f"its process {end}")
    kind, body = message[:1], message[1:]
    if kind == _DONE:
        return body
    text = body.decode(errors="replace")
    if kind == _FATAL:
        name, _, detail = text.partition(" ")
        raise _FATAL_ERRORS[name](detail)
    return ItemFailure("exception", text)


def _measure_resident_mb(child: ForkProcess) -> float:
    try:
        return float(psutil.Process(child.pid).memory_info().rss) / 1e6
    except psutil.Error:  # the child has just ended, which the pipe reports
        return 0.0


def _serve(parent: int, work: Callable[[int], bytes], items: range, sender: Connection) -> None:
    """Answer the items in the child, which never returns from here."""
    status = 1
    try:
        die_with_parent(parent)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends the child
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        faulthandler.disable()  # the parent reports how the child ended; no trace on the terminal
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        for item in items:
            try:
                message = _DONE + work(item)
            except Exception as error:  # noqa: BLE001 every error is the item's answer
                message = _encode_error(error)
            sender.send_bytes(message)
        status = 0
    finally:
        os._exit(status)  # skip the parent's exit handlers


def _encode_error(error: Exception) -> bytes:
    name, detail = type(error).__name__, " ".join(str(error).split())
    if _FATAL_ERRORS.get(name) is type(error):
        return _FATAL + f"{name} {detail[:_MAX_MESSAGE]}".encode(errors="replace")
    return _RAISED + f"{name}: {detail}"[:_MAX_MESSAGE].encode(errors="replace")
