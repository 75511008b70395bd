"""A child process with a deadline and a memory limit, in which native code may crash without harm to the build."""

import fcntl
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import BinaryIO

import psutil

from schemas.codec import decode, encode
from schemas.outcome import Failed
from schemas.work import SandboxSetup, StageCall, StageReport
from tableverse_factory.errors import BuildError
from workers.channel import Channel, ChannelClosedError

START_S = 180.0
"""Wall time that a child may take to import the pipeline [s]."""
MAX_LOSSES = 3
"""How often a child may be killed from outside during one call before the call is given up."""
_MB = 1_000_000
_TRACE_CHARS = 4000
_LAST_BYTES = 64 * 1024
_ONE_THREAD = (
    "OMP_NUM_THREADS",
    "OPENBLAS_NUM_THREADS",
    "MKL_NUM_THREADS",
    "NUMEXPR_NUM_THREADS",
    "BLIS_NUM_THREADS",
    "VECLIB_MAXIMUM_THREADS",
)


class Sandbox:
    """Runs stages in a child, which it replaces after a crash, a hang or too much memory."""

    def __init__(self, setup: SandboxSetup) -> None:
        self._setup = setup
        self._child: _Child | None = None

    def run(self, call: StageCall, item: bytes, watch: Callable[[], None] = lambda: None) -> tuple[StageReport, bytes]:
        """Runs one stage on one scene, again after a crash, a hang or too much memory as often as the setup allows.

        Args:
            call: Which stage, on which scene.
            item: The encoded input.
            watch: Called every few milliseconds; what it raises ends the call and the child.

        Returns:
            The report, and the encoded next record (empty unless the stage is done).

        Raises:
            BuildError: if no child can be started at all.
        """
        losses, attempt = 0, 1
        while True:
            report, value = self._attempt(call, item, watch)
            if report is None:
                losses += 1
                if losses >= MAX_LOSSES:
                    text = f"its process was killed from outside {losses} times: is this machine out of memory?"
                    return StageReport(Failed("lost", text), attempt, 0.0, 0.0), b""
                continue
            if not _may_retry(report) or attempt >= self._setup.attempts:
                return replace(report, attempts=attempt), value
            attempt += 1

    def close(self) -> None:
        """Kills the child, at once."""
        if self._child is not None:
            self._child.kill()
            self._child = None

    def _attempt(
        self, call: StageCall, item: bytes, watch: Callable[[], None]
    ) -> tuple[StageReport, bytes] | tuple[None, bytes]:
        """One attempt; None where the child was killed from outside."""
        keep = False
        try:
            if self._child is None:
                self._child = _Child(self._setup, watch)
            report, value = self._child.call(call, item, watch)
            keep = report is not None and not _may_retry(report) and self._child.is_lean()
        except _KilledError:
            return None, b""
        finally:
            if not keep:
                self.close()
        return (report, value) if report is not None else (None, b"")


class _Child:
    """One process, from its start to its end."""

    def __init__(self, setup: SandboxSetup, watch: Callable[[], None]) -> None:
        self._setup = setup
        self._errors: BinaryIO = tempfile.TemporaryFile()  # noqa: SIM115 closed in kill
        fcntl.fcntl(self._errors, fcntl.F_SETFL, os.O_APPEND)
        mine, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "workers.child", str(theirs.fileno()), str(os.getpid())],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._errors,
                env=_environment(),
                start_new_session=True,
            )
        self._channel = Channel(mine)
        self._usage = psutil.Process(self._process.pid)
        self._rss = 0
        try:
            self._wait_until_ready(watch)
        except BaseException:
            self.kill()
            raise

    def call(self, call: StageCall, item: bytes, watch: Callable[[], None]) -> tuple[StageReport | None, bytes]:
        """One call; no report where the child was killed from outside."""
        self._errors.truncate(0)
        started, cpu = time.monotonic(), self._cpu()
        limit = self._setup.memory_mb * _MB

        def look() -> None:
            watch()
            self._rss = self._resident()
            if self._rss > limit:
                raise _OutOfMemoryError

        try:
            self._channel.send(encode(call), item)
            if not self._channel.wait(started + call.deadline_s, look):
                failure = Failed("timeout", f"no answer within {call.deadline_s:g} s")
                return self._ended(failure, started, cpu), b""
            return decode(self._channel.receive()), self._channel.receive()
        except _OutOfMemoryError:
            failure = Failed("out_of_memory", f"more than {self._setup.memory_mb} MB of resident memory")
            return self._ended(failure, started, cpu), b""
        except ChannelClosedError:
            how = self._how_it_died()
            return (None if how is None else self._ended(Failed("crash", how), started, cpu)), b""

    def is_lean(self) -> bool:
        """Whether the idle child holds less than half of the limit: the next scene must not pay for this one."""
        return self._resident() < self._setup.memory_mb * _MB / 2

    def kill(self) -> None:
        """Ends the process and everything it started."""
        self._channel.close()
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        self._errors.close()

    def _wait_until_ready(self, watch: Callable[[], None]) -> None:
        try:
            self._channel.send(encode(self._setup))
            if not self._channel.wait(time.monotonic() + START_S, watch):
                raise BuildError(f"the pipeline {self._setup.pipeline} was not imported within {START_S:g} s")
            answer = decode(self._channel.receive())
        except ChannelClosedError:
            how = self._how_it_died()
            if how is None:
                raise _KilledError from None
            raise BuildError(f"a sandbox died while starting ({how}): {self._trace()}") from None
        if isinstance(answer, Failed):
            raise BuildError(f"the pipeline {self._setup.pipeline} does not start: {answer.message}")

    def _ended(self, failure: Failed, started: float, cpu: float) -> StageReport:
        return StageReport(failure, 1, max(0.0, self._cpu() - cpu), time.monotonic() - started, self._trace())

    def _how_it_died(self) -> str | None:
        """In words; None where the cause lies outside (SIGKILL or SIGTERM, which no stage raises by accident)."""
        try:
            code = self._process.wait(timeout=10.0)
        except subprocess.TimeoutExpired:
            return "closed its channel"
        if code in (-signal.SIGKILL, -signal.SIGTERM):
            return None
        return signal.Signals(-code).name if code < 0 else f"exit code {code}"

    def _resident(self) -> int:
        try:
            return int(self._usage.memory_info().rss)
        except psutil.Error:
            return 0

    def _cpu(self) -> float:
        try:
            times = self._usage.cpu_times()
        except psutil.Error:
            return 0.0
        return float(times.user + times.system)

    def _trace(self) -> str:
        """The last words on stderr: from the crash report on, where there is one."""
        length = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, length - _LAST_BYTES))
        text = self._errors.read(_LAST_BYTES).decode(errors="replace")
        start = text.rfind("Fatal Python error")
        last = text[start:].partition("Extension modules:")[0][:_TRACE_CHARS] if start >= 0 else text[-_TRACE_CHARS:]
        return last.strip()


def _may_retry(report: StageReport) -> bool:
    """Whether the process is to blame and another one may succeed; an exception comes again for the same input."""
    return isinstance(report.outcome, Failed) and report.outcome.error_kind in ("crash", "timeout", "out_of_memory")


class _OutOfMemoryError(Exception):
    """The child holds more than it may."""


class _KilledError(Exception):
    """The child was killed from outside before it was ready."""


def _environment() -> dict[str, str]:
    """This process's environment with everything pinned that could make results differ between machines or runs."""
    installed = {sys.prefix, sys.base_prefix, sys.exec_prefix}
    added = [path for path in sys.path if path and not any(Path(path).is_relative_to(folder) for folder in installed)]
    pinned = dict.fromkeys(_ONE_THREAD, "1") | {"PYTHONHASHSEED": "0", "PYTHONPATH": os.pathsep.join(added)}
    return {**os.environ, **pinned}
