"""The process inside a sandbox: runs the stages it is told to, and says how each ended. Started as `workers.sandbox.child`."""

import ctypes
import faulthandler
import importlib
import os
import resource
import signal
import socket
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
from threadpoolctl import threadpool_limits

from schemas.codec import decode, encode
from schemas.config import Config
from schemas.manifest import SceneKind
from schemas.outcome import Done, Dropped, Failed
from schemas.scene import ExportedScene
from schemas.work import SandboxSetup, StageCall, StageChain, StageReport
from tableverse_factory.core.errors import BuildError, TableverseError
from tableverse_factory.core.open3d_import import stub_plotly
from tableverse_factory.core.seeding import rng_for
from tableverse_factory.core.storage.files import parse_path
from tableverse_factory.dataset.shards import check_exported
from tableverse_factory.models.remote.cost_meter import Meter
from tableverse_factory.models.services import Services
from tableverse_factory.stage import Pipelines, Stage
from workers.sandbox.channel import Channel, ChannelClosedError
from workers.sandbox.error_text import bounded_drop, bounded_failure, failure_from_exception
from workers.sandbox.messages import InputMissing, StageDone, encode_message
from workers.state.checkpoint_store import CheckpointStore, cost_record
from workers.state.cost_log import SpendingLog

_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Serves one sandbox until it hangs up: `workers.sandbox.child SOCKET_DESCRIPTOR PARENT_PID`."""
    descriptor, parent = int(sys.argv[1]), int(sys.argv[2])
    _die_with(parent)
    faulthandler.enable()
    stub_plotly()
    channel = Channel(socket.socket(fileno=descriptor))
    setup: SandboxSetup = decode(channel.receive())
    try:
        runner = StageRunner(setup)
    except Exception as error:  # noqa: BLE001 whatever the pipeline's import raises must reach the user
        channel.send(encode(Failed(type(error).__name__, f"{error}\n{traceback.format_exc()}")))
        return
    channel.send(encode("ready"))
    with threadpool_limits(1):
        _serve(channel, runner)


class StageRunner:
    """Runs any stage of the lines, in this process and on one thread."""

    def __init__(self, setup: SandboxSetup) -> None:
        """Imports the lines and makes the services.

        Raises:
            BuildError: if the pipeline is not there.
        """
        self._lines = load_pipelines(setup.pipeline)
        self._config = Config.model_validate_json(setup.config_json)
        folder = parse_path(setup.records_dir)
        self._spending = SpendingLog(folder.parent)
        self._meter = Meter(self._spending.add)
        self._services = Services(Path(setup.cache_dir), self._config.asking, self._meter)
        self._records = CheckpointStore(folder)

    def run_chain(self, chain: StageChain, item: bytes, say: Callable[..., None]) -> None:
        """Runs stages until one is not done, and says how each ended; what it gave is on the disk by then.

        Raises:
            BuildError: if a record cannot be written.
        """
        if chain.input_record:
            kept = self._records.read(chain.input_record)
            if kept is None:
                say(encode_message(InputMissing()))
                return
            item = kept
        self._meter.allow(chain.allowance)
        self._spending.grant = chain.allowance.name
        for call, record in zip(chain.calls, chain.output_records, strict=True):
            report, item = self.run(call, item)
            if record and report.outcome is None:
                if report.cost:  # comes first: where the record is, this is
                    self._records.write(cost_record(record), encode(report.cost))
                self._records.write(record, item)
            if report.outcome is not None:
                say(encode_message(report))
                return
            done = encode_message(StageDone(report, _cpu_s()))
            say(done, item) if call is chain.calls[-1] else say(done)

    def run(self, call: StageCall, item: bytes) -> tuple[StageReport, bytes]:
        """Runs one stage; whatever Python can catch becomes its outcome."""
        started, cpu = time.monotonic(), _cpu_s()
        self._meter.reset()
        stage, last = self._stage(call)
        value, trace = b"", ""
        outcome: Dropped | Failed | None = None
        try:
            answer = stage.run(
                decode(item), self._config, rng_for(self._config.run.seed, call.scene_id, stage.name), self._services
            )
            if last and isinstance(answer, Done):
                _check_last(answer.value, call.scene_id)
            outcome, value = _unpack(answer, stage.name)
        except (Exception, SystemExit, KeyboardInterrupt) as error:  # noqa: BLE001 every error is a row, never the end
            outcome, value = failure_from_exception(error), b""
            trace = "" if isinstance(error, TableverseError) else "".join(traceback.format_exception(error))[-4000:]
        wall_s, spent = time.monotonic() - started, (self._meter.cost, self._meter.paid)
        return StageReport(outcome, 1, _cpu_s() - cpu, wall_s, trace, *spent), value

    def _stage(self, call: StageCall) -> tuple[Stage, bool]:
        line = self._lines[SceneKind(call.kind)]
        return line[call.position], call.position == len(line) - 1


def load_pipelines(reference: str) -> Pipelines:
    """The lines at `module:attribute`.

    Raises:
        BuildError: if there is no such module or attribute.
    """
    module, _, attribute = reference.partition(":")
    try:
        lines: Pipelines = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError) as error:
        raise BuildError(f"the pipeline {reference!r} cannot be loaded: {error}") from error
    return lines


def _cpu_s() -> float:
    """CPU time of this process, and of those that it started and that have ended [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _unpack(answer: Any, stage: str) -> tuple[Dropped | Failed | None, bytes]:
    match answer:
        case Done(value=value):
            return None, encode(value)
        case Dropped():
            return bounded_drop(answer), b""
        case Failed():
            return bounded_failure(answer), b""
    raise TypeError(f"stage {stage} answered a {type(answer).__name__}, not an Outcome")


def _check_last(value: Any, scene_id: str) -> None:
    if not isinstance(value, ExportedScene):
        raise TypeError(f"the last stage gave a {type(value).__name__}, not an ExportedScene")
    check_exported(value, scene_id)


def _serve(channel: Channel, runner: StageRunner) -> None:
    while True:
        try:
            chain, item = decode(channel.receive()), channel.receive()
            runner.run_chain(chain, item, channel.send)
        except ChannelClosedError:
            return
        except BuildError as error:
            channel.send(encode_message(Failed(type(error).__name__, str(error))))


def _die_with(parent: int) -> None:
    """Ends this process with its parent, even inside endless native code; no core dumps; arrow on one thread."""
    ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    if os.getppid() != parent:
        sys.exit(0)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)


if __name__ == "__main__":
    main()
