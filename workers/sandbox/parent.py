"""Sandbox: a child process with a deadline and a memory limit, in which native code may crash without harm."""

import fcntl
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import BinaryIO

import psutil

from schemas.codec import decode, encode
from schemas.outcome import Failed
from schemas.work import SandboxSetup, StageChain, StageChainReport, StageReport
from tableverse_factory.core.errors import BuildError
from workers.sandbox.channel import POLL_S, Channel, ChannelClosedError
from workers.sandbox.messages import InputMissing, StageDone, decode_message
from workers.sandbox.retries import ChainRun, ChildResult, may_retry

START_TIMEOUT_S = 180.0  # timeout for a child to import the pipeline [s]
_EXIT_S = 10.0  # time that a child has to end after it closed its channel [s]
_MB = 1_000_000
_TRACE_CHARS = 4000
_STDERR_TAIL_BYTES = 64 * 1024
_THREAD_VARIABLES = (
    *(f"{library}_NUM_THREADS" for library in ("OMP", "OPENBLAS", "MKL", "NUMEXPR", "BLIS")),
    "VECLIB_MAXIMUM_THREADS",
)


class Sandbox:
    """Runner of stages in a child process, which is replaced after a crash, a hang or too much memory."""

    def __init__(self, setup: SandboxSetup) -> None:
        self._setup = setup
        self._child: _Child | None = None

    def run(self, chain: StageChain, watch: Callable[[], None] = lambda: None) -> StageChainReport:
        """Run a chain of stages on one scene until one of them is not done.

        A stage that crashes, hangs or takes too much memory is repeated in a new child as often as the setup allows,
        and once more if that happened first in a used one, from the checkpoint of the stage before it. `watch` is
        called every few milliseconds; an exception of it ends the call and the child.
        """
        run = ChainRun(chain, self._setup.attempts)
        while True:
            if run.needs_new_child:
                self.close()
            report = run.add_result(self._run_once(run.rest, watch))
            if report is not None:
                return report

    def close(self) -> None:
        """Kill the child at once."""
        if self._child is not None:
            self._child.kill()
            self._child = None

    def _run_once(self, chain: StageChain, watch: Callable[[], None]) -> ChildResult:
        """Run a chain in the child; close the child after a failure that a new one may not have."""
        keep_child = False
        try:
            if self._child is not None and not self._child.is_alive():
                self.close()  # it died while idle: no scene is to blame
            if self._child is None:
                self._child = _Child(self._setup, watch)
            result = self._child.call(chain, watch)
            keep_child = not (result.killed or any(map(may_retry, result.reports))) and self._child.is_lean()
        except _KilledError:
            return ChildResult(killed=True)
        finally:
            if not keep_child:
                self.close()
        return result


class _Child:
    def __init__(self, setup: SandboxSetup, watch: Callable[[], None]) -> None:
        self._setup = setup
        self._errors: BinaryIO = tempfile.TemporaryFile()  # noqa: SIM115 closed in kill
        fcntl.fcntl(self._errors, fcntl.F_SETFL, os.O_APPEND)
        own_end, child_end = socket.socketpair()
        with child_end:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "workers.sandbox.child", str(child_end.fileno()), str(os.getpid())],
                pass_fds=(child_end.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._errors,
                env=_make_environment(),
                start_new_session=True,
            )
        self._channel = Channel(own_end)
        self._usage = psutil.Process(self._process.pid)
        self._cpu_s = 0.0
        self._is_new = True
        try:
            self._wait_until_ready(watch)
        except BaseException:
            self.kill()
            raise

    def call(self, chain: StageChain, watch: Callable[[], None]) -> ChildResult:
        """Run a chain, or as much of it as the child survives."""
        self._errors.truncate(0)
        result = ChildResult(new_child=self._is_new)
        self._is_new = False
        started = time.monotonic()
        try:
            self._channel.send(encode(chain))
            for call in chain.calls:
                started = time.monotonic()
                failure = self._wait(call.deadline_s, watch)
                if failure is not None:
                    result.reports.append(self._make_report(failure, started))
                    return result
                match decode_message(self._channel.receive()):
                    case StageDone(report=report, cpu_s=cpu_s, output=output):
                        self._cpu_s = cpu_s
                        result.reports.append(report)
                        result.outputs.append(output)
                    case StageReport() as report:
                        self._cpu_s += report.cpu_s
                        result.reports.append(report)
                        return result
                    case InputMissing():
                        result.input_lost = True
                        return result
                    case Failed(message=message):
                        raise BuildError(message)
        except ChannelClosedError:
            reason = self._describe_exit()
            if reason is None:
                result.killed = True
            else:
                result.reports.append(self._make_report(Failed("crash", reason), started))
        return result

    def _wait(self, deadline_s: float, watch: Callable[[], None]) -> Failed | None:
        """Wait for the end of a stage; returns the failure if it does not come."""
        limit = self._setup.memory_mb * _MB

        def check() -> None:
            watch()
            if self._measure_rss() > limit:
                raise _OutOfMemoryError

        try:
            if not self._channel.wait(time.monotonic() + deadline_s, check):
                return Failed("timeout", f"no answer within {deadline_s:g} s")
        except _OutOfMemoryError:
            return Failed("out_of_memory", f"more than {self._setup.memory_mb} MB of resident memory")
        return None

    def is_alive(self) -> bool:
        """Whether the process can take work; one whose threads are still ending exists but is dead."""
        if self._process.returncode is not None:
            return False
        try:
            return self._usage.status() != psutil.STATUS_ZOMBIE  # `poll` would reap it, see `_end`
        except psutil.NoSuchProcess:
            return False

    def is_lean(self) -> bool:
        """Whether the idle child holds less than half of the limit, so that the next scene has room."""
        return self._measure_rss() < self._setup.memory_mb * _MB / 2

    def kill(self) -> None:
        """Kill the process and everything it started."""
        self._channel.close()
        self._end()
        self._errors.close()

    def _end(self) -> int:
        """Kill the process and its group, and return its exit code; only once it is reaped may others get its id."""
        if self._process.returncode is None:
            with suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
        return self._process.wait()

    def _wait_until_ready(self, watch: Callable[[], None]) -> None:
        try:
            self._channel.send(encode(self._setup))
            if not self._channel.wait(time.monotonic() + START_TIMEOUT_S, watch):
                raise BuildError(f"the pipeline {self._setup.pipeline} was not imported within {START_TIMEOUT_S:g} s")
            answer = decode(self._channel.receive())
        except ChannelClosedError:
            reason = self._describe_exit()
            if reason is None:
                raise _KilledError from None
            raise BuildError(f"a sandbox died while starting ({reason}): {self._read_stderr_tail()}") from None
        if isinstance(answer, Failed):
            raise BuildError(f"the pipeline {self._setup.pipeline} does not start: {answer.message}")
        self._cpu_s = self._measure_cpu_s()

    def _make_report(self, failure: Failed, started: float) -> StageReport:
        """Make the report of a stage that cannot report itself."""
        cpu_s = max(0.0, self._measure_cpu_s() - self._cpu_s)
        return StageReport(failure, 1, cpu_s, time.monotonic() - started, self._read_stderr_tail())

    def _describe_exit(self) -> str | None:
        """Describe the exit; None for an outside cause (SIGKILL or SIGTERM, which no stage raises by accident)."""
        until = time.monotonic() + _EXIT_S
        while self.is_alive():
            if time.monotonic() > until:
                return "closed its channel"
            time.sleep(POLL_S)
        code = self._end()
        if code in (-signal.SIGKILL, -signal.SIGTERM):
            return None
        return signal.Signals(-code).name if code < 0 else f"exit code {code}"

    def _measure_rss(self) -> int:
        try:
            return int(self._usage.memory_info().rss)
        except psutil.Error:
            return 0

    def _measure_cpu_s(self) -> float:
        try:
            times = self._usage.cpu_times()
        except psutil.Error:
            return 0.0
        return float(times.user + times.system + times.children_user + times.children_system)

    def _read_stderr_tail(self) -> str:
        """Read the end of stderr, from the crash report on if there is one."""
        length = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, length - _STDERR_TAIL_BYTES))
        text = self._errors.read(_STDERR_TAIL_BYTES).decode(errors="replace")
        start = text.rfind("Fatal Python error")
        last = text[start:].partition("Extension modules:")[0][:_TRACE_CHARS] if start >= 0 else text[-_TRACE_CHARS:]
        return last.strip()


class _OutOfMemoryError(Exception):
    """The child exceeds its memory limit."""


class _KilledError(Exception):
    """The child was killed from outside before it was ready."""


def _make_environment() -> dict[str, str]:
    """Copy this environment with everything pinned that could make results differ between machines or runs.

    The current folder is left out of PYTHONPATH: a stray `json.py` there would be imported.
    """
    installed = {sys.prefix, sys.base_prefix, sys.exec_prefix}
    wanted = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    found = [path for path in sys.path if path and not any(Path(path).is_relative_to(folder) for folder in installed)]
    added = dict.fromkeys([*wanted, *(path for path in found if path in wanted or Path(path).resolve() != Path.cwd())])
    pinned = dict.fromkeys(_THREAD_VARIABLES, "1") | {"PYTHONHASHSEED": "0", "PYTHONPATH": os.pathsep.join(added)}
    if _has_avx2():  # OpenBLAS chooses its kernels by the processor, and they differ in last digits
        pinned["OPENBLAS_CORETYPE"] = "Haswell"
    return {**os.environ, **pinned}


@cache
def _has_avx2() -> bool:
    try:
        return " avx2 " in Path("/proc/cpuinfo").read_text()
    except OSError:
        return False
