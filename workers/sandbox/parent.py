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
from pathlib import Path
from typing import BinaryIO

import psutil

from schemas.codec import decode, encode
from schemas.outcome import Failed
from schemas.work import SandboxSetup, StageChain, StageChainReport, StageReport
from tableverse_factory.core.errors import BuildError
from workers.sandbox.channel import Channel, ChannelClosedError
from workers.sandbox.messages import InputMissing, StageDone
from workers.sandbox.messages import decode_message as understood
from workers.sandbox.retries import ChainRun, ChildResult, may_retry

START_S = 180.0
"""Wall time that a child may take to import the pipeline [s]."""
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

    def run(
        self, chain: StageChain, item: bytes, watch: Callable[[], None] = lambda: None
    ) -> tuple[StageChainReport, bytes]:
        """Runs a chain of stages on one scene until one of them is not done.

        A stage that crashes, hangs or takes too much memory is run again as often as the setup allows, in a new child,
        from what the stage before it left on the disk.

        Args:
            chain: Which stages, on which scene.
            item: The encoded input; not looked at where the chain names a record.
            watch: Called every few milliseconds; what it raises ends the call and the child.

        Returns:
            The reports, and the encoded output of the last stage (empty unless it is done).

        Raises:
            BuildError: if no child can be started at all, or it cannot write.
        """
        run = ChainRun(chain, self._setup.attempts)
        while True:
            heard = self._hear(run.rest, item, watch)
            report = run.take(heard)
            if report is not None:
                return report, heard.value

    def close(self) -> None:
        """Kills the child, at once."""
        if self._child is not None:
            self._child.kill()
            self._child = None

    def _hear(self, chain: StageChain, item: bytes, watch: Callable[[], None]) -> ChildResult:
        """What a child says of a chain; it does not live on after a failure that a new one may not have."""
        keep = False
        try:
            if self._child is not None and not self._child.is_alive():
                self.close()  # it died while it had nothing to do: no scene is to blame
            if self._child is None:
                self._child = _Child(self._setup, watch)
            heard = self._child.call(chain, item, watch)
            keep = not (heard.killed or any(map(may_retry, heard.reports))) and self._child.is_lean()
        except _KilledError:
            return ChildResult(killed=True)
        finally:
            if not keep:
                self.close()
        return heard


class _Child:
    """One process, from its start to its end."""

    def __init__(self, setup: SandboxSetup, watch: Callable[[], None]) -> None:
        self._setup = setup
        self._errors: BinaryIO = tempfile.TemporaryFile()  # noqa: SIM115 closed in kill
        fcntl.fcntl(self._errors, fcntl.F_SETFL, os.O_APPEND)
        mine, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "workers.sandbox.child", str(theirs.fileno()), str(os.getpid())],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=self._errors,
                env=_environment(),
                start_new_session=True,
            )
        self._channel = Channel(mine)
        self._usage = psutil.Process(self._process.pid)
        self._cpu_s = 0.0
        try:
            self._wait_until_ready(watch)
        except BaseException:
            self.kill()
            raise

    def call(self, chain: StageChain, item: bytes, watch: Callable[[], None]) -> ChildResult:
        """Runs a chain, or as much of it as the child survives."""
        self._errors.truncate(0)
        heard = ChildResult()
        started = time.monotonic()
        try:
            self._channel.send(encode(chain), item)
            for call in chain.calls:
                started = time.monotonic()
                failure = self._wait(call.deadline_s, watch)
                if failure is not None:
                    heard.reports.append(self._ended(failure, started))
                    return heard
                match understood(self._channel.receive()):
                    case StageDone(report=report, cpu_s=cpu_s):
                        if call is chain.calls[-1]:  # a stage is done when what it gave is here
                            heard.value = self._channel.receive()
                        self._cpu_s = cpu_s
                        heard.reports.append(report)
                    case StageReport() as report:
                        self._cpu_s += report.cpu_s
                        heard.reports.append(report)
                        return heard
                    case InputMissing():
                        heard.input_lost = True
                        return heard
                    case Failed(message=message):
                        raise BuildError(message)
        except ChannelClosedError:
            how = self._how_it_died()
            if how is None:
                heard.killed = True
            else:
                heard.reports.append(self._ended(Failed("crash", how), started))
        return heard

    def _wait(self, deadline_s: float, watch: Callable[[], None]) -> Failed | None:
        """Waits for the end of a stage; what went wrong if it does not come."""
        limit = self._setup.memory_mb * _MB

        def look() -> None:
            watch()
            if self._resident() > limit:
                raise _OutOfMemoryError

        try:
            if not self._channel.wait(time.monotonic() + deadline_s, look):
                return Failed("timeout", f"no answer within {deadline_s:g} s")
        except _OutOfMemoryError:
            return Failed("out_of_memory", f"more than {self._setup.memory_mb} MB of resident memory")
        return None

    def is_alive(self) -> bool:
        """Whether the process can be given work; one whose threads are still ending is not yet gone, and yet dead."""
        return self._process.poll() is None and self._usage.status() != psutil.STATUS_ZOMBIE

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
        self._cpu_s = self._cpu()

    def _ended(self, failure: Failed, started: float) -> StageReport:
        """The report of a stage that cannot report itself."""
        cpu_s = max(0.0, self._cpu() - self._cpu_s)
        return StageReport(failure, 1, cpu_s, time.monotonic() - started, self._trace())

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
        return float(times.user + times.system + times.children_user + times.children_system)

    def _trace(self) -> str:
        """The last words on stderr: from the crash report on, where there is one."""
        length = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(0, length - _LAST_BYTES))
        text = self._errors.read(_LAST_BYTES).decode(errors="replace")
        start = text.rfind("Fatal Python error")
        last = text[start:].partition("Extension modules:")[0][:_TRACE_CHARS] if start >= 0 else text[-_TRACE_CHARS:]
        return last.strip()


class _OutOfMemoryError(Exception):
    """The child holds more than it may."""


class _KilledError(Exception):
    """The child was killed from outside before it was ready."""


def _environment() -> dict[str, str]:
    """This process's environment with everything pinned that could make results differ between machines or runs.

    The folder that a build is started from is no place for code: a stray `json.py` there would be imported.
    """
    installed = {sys.prefix, sys.base_prefix, sys.exec_prefix}
    asked = [path for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path]
    found = [path for path in sys.path if path and not any(Path(path).is_relative_to(folder) for folder in installed)]
    added = dict.fromkeys([*asked, *(path for path in found if path in asked or Path(path).resolve() != Path.cwd())])
    pinned = dict.fromkeys(_ONE_THREAD, "1") | {"PYTHONHASHSEED": "0", "PYTHONPATH": os.pathsep.join(added)}
    return {**os.environ, **pinned}
