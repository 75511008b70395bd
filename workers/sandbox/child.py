"""Process inside a sandbox: runs stages and reports their outcomes. Started as `python -m workers.sandbox.child`."""

import faulthandler
import importlib
import resource
import socket
import sys
import time
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
from threadpoolctl import threadpool_limits

from schemas.codec import decode, encode, normalize
from schemas.config import Config
from schemas.outcome import Done, Dropped, Failed
from schemas.scene import ExportedScene
from schemas.work import SandboxSetup, ScenePart, StageChain, StageReport
from tableverse_factory.core.errors import BuildError, TableverseError
from tableverse_factory.core.parent_death import die_with_parent
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.core.storage.files import parse_path
from tableverse_factory.dataset.parts import PartWriter
from tableverse_factory.dataset.shards import check_exported
from tableverse_factory.models.remote.cost_meter import Meter
from tableverse_factory.models.services import Services
from tableverse_factory.stage import Pipelines, Stage, check_stages, import_stages
from workers.sandbox.channel import Channel, ChannelClosedError
from workers.sandbox.error_text import bound_drop, bound_failure, make_failure
from workers.sandbox.messages import InputMissing, StageDone, encode_message
from workers.state.checkpoint_store import CheckpointStore, name_checkpoint, name_cost_checkpoint
from workers.state.cost_log import CostLog


def main() -> None:
    """Serve one sandbox until it closes the channel: `workers.sandbox.child SOCKET_DESCRIPTOR PARENT_PID`."""
    descriptor, parent = int(sys.argv[1]), int(sys.argv[2])
    die_with_parent(parent)
    _limit_process()
    faulthandler.enable()
    channel = Channel(socket.socket(fileno=descriptor))
    setup: SandboxSetup = decode(channel.receive())
    try:
        runner = StageRunner(setup)
    except Exception as error:  # noqa: BLE001 any error of the pipeline's import must reach the user
        channel.send(encode(Failed(type(error).__name__, f"{error}\n{traceback.format_exc()}")))
        return
    channel.send(encode("ready"))
    with threadpool_limits(1):
        _serve(channel, runner)


class StageRunner:
    """Runner of any stage of the pipelines, in this process and on one thread."""

    def __init__(self, setup: SandboxSetup) -> None:
        """Import the pipelines with their stages, and create the services."""
        self._pipelines = load_pipelines(setup.pipeline)
        import_stages(self._pipelines.values())  # counts in no deadline, and in the time of no scene
        self._config = Config.model_validate_json(setup.config_json)
        folder = parse_path(setup.records_dir)
        self._spending = CostLog(folder.parent)
        self._meter = Meter(self._spending.add)
        self._services = Services(Path(setup.cache_dir), self._config.asking, self._meter)
        self._records, self._parts = CheckpointStore(folder), PartWriter(folder.parent)

    def run_chain(self, chain: StageChain, send: Callable[[bytes], None]) -> None:
        """Run stages until one is not done, and report each after its output is written.

        A stage gets what the one before it gave, in the form in which it would be read back.
        """
        stored, item = None, chain.row
        if chain.input:
            stored = self._records.read(chain.input)
            if stored is None:
                send(encode_message(InputMissing()))
                return
            item = stored.record
        self._meter.allow(chain.allowance)
        self._spending.grant = chain.allowance.name
        stages = self._pipelines[chain.row.kind]
        for position, call in enumerate(chain.calls, chain.position):
            report, item = self._run_stage(chain, stages[position], item, is_last=not call.key)
            if report.outcome is not None:
                send(encode_message(report))
                return
            output: ScenePart | str
            if call.key:
                name = name_checkpoint(chain.shard, chain.row.scene_id, stages[position].name, call.key)
                if report.cost:  # first: a checkpoint never lacks its cost
                    self._records.write(name_cost_checkpoint(name), report.cost)
                stored = self._records.write(name, item, stored)
                output = stored.name
            else:
                output = self._parts.write(chain.shard, item)
            send(encode_message(StageDone(report, _measure_cpu_s(), output)))

    def _run_stage(self, chain: StageChain, stage: Stage, item: Any, is_last: bool) -> tuple[StageReport, Any]:
        """Run one stage; every exception becomes its outcome."""
        started, cpu = time.monotonic(), _measure_cpu_s()
        self._meter.reset()
        scene_id, trace, value = chain.row.scene_id, "", None
        outcome: Dropped | Failed | None = None
        try:
            if chain.failure is not None and stage.record_failure is not None:
                answer: Any = Done(stage.record_failure(item, self._config, chain.failure))
            else:
                rng = make_rng(self._config.run.seed, scene_id, stage.name)
                answer = stage.run(item, self._config, rng, self._services)
            outcome, value = _take_outcome(answer, stage.name)
            if is_last and outcome is None:
                _check_last_output(value, scene_id)
        except (Exception, SystemExit, KeyboardInterrupt) as error:  # noqa: BLE001 every error is a row
            outcome = make_failure(error)
            trace = "" if isinstance(error, TableverseError) else "".join(traceback.format_exception(error))[-4000:]
        wall_s, spent = time.monotonic() - started, (self._meter.cost, self._meter.paid)
        return StageReport(outcome, 1, _measure_cpu_s() - cpu, wall_s, trace, *spent), value


def load_pipelines(reference: str) -> Pipelines:
    """Load the pipelines at `module:attribute`, and look for the modules of their stages."""
    module, _, attribute = reference.partition(":")
    try:
        pipelines: Pipelines = getattr(importlib.import_module(module), attribute)
        check_stages(pipelines.values())
    except (ImportError, AttributeError) as error:
        raise BuildError(f"the pipeline {reference!r} cannot be loaded: {error}") from error
    return pipelines


def _measure_cpu_s() -> float:
    """Measure the CPU time of this process and of its children that have ended [s]."""
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return time.process_time() + children.ru_utime + children.ru_stime


def _take_outcome(answer: Any, stage: str) -> tuple[Dropped | Failed | None, Any]:
    match answer:
        case Done(value=value):
            return None, normalize(value)
        case Dropped():
            return bound_drop(answer), None
        case Failed():
            return bound_failure(answer), None
    raise TypeError(f"stage {stage} answered a {type(answer).__name__}, not an Outcome")


def _check_last_output(value: Any, scene_id: str) -> None:
    if not isinstance(value, ExportedScene):
        raise TypeError(f"the last stage gave a {type(value).__name__}, not an ExportedScene")
    check_exported(value, scene_id)


def _serve(channel: Channel, runner: StageRunner) -> None:
    while True:
        try:
            runner.run_chain(decode(channel.receive()), channel.send)
        except ChannelClosedError:
            return
        except BuildError as error:
            channel.send(encode_message(Failed(type(error).__name__, str(error))))


def _limit_process() -> None:
    """Disable core dumps; run arrow on one thread."""
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    pa.set_cpu_count(1)
    pa.set_io_thread_count(1)


if __name__ == "__main__":
    main()
