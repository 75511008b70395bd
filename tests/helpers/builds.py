"""Helpers of the build tests: manifests for the tiny pipeline, builds in processes of their own, trees as hashes."""

import hashlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from schemas.config import Config, RunConfig
from schemas.manifest import ImageRow
from schemas.work import SandboxSetup, SceneResult, StageCall, StageChain
from tests.helpers.paths import HELPERS
from workers.run import BuildRequest, BuildSummary, run_build
from workers.sandbox.child import StageRunner
from workers.sandbox.messages import decode_message

QUICK = {"shard_size": 4, "deadline_s": 8.0, "memory_mb": 400}


class Silent:
    """A display that keeps its notes."""

    def __init__(self):
        self.notes = []

    def show(self, tally):
        pass

    def note(self, line):
        self.notes.append(line)


def write_manifest(path: Path, names: list[str], root: str = "/data") -> Path:
    rows = [
        {"scene_id": f"scene_{i:03d}", "kind": "capture", "uri": f"{root}/{i}", "name": name, "licence": "CC0"}
        for i, name in enumerate(names)
    ]
    pq.write_table(pa.Table.from_pylist(rows), path)
    return path


def request(manifest: Path, out: Path, **run: object) -> BuildRequest:
    config = Config(run=RunConfig(**{**QUICK, **run}))
    return BuildRequest(
        manifest, out, config, cache_dir=manifest.parent / "cache", pipeline="tests.helpers.tiny_pipeline:PIPELINES"
    )


def build(manifest: Path, out: Path, **run: object) -> BuildSummary:
    return run_build(request(manifest, out, **run), Silent())


def compute(row: ImageRow, out: Path, shard: int = 0) -> SceneResult:
    """The result of a scene that the tiny pipeline gets done, computed in this process."""
    setup = SandboxSetup(
        "tests.helpers.tiny_pipeline:PIPELINES",
        Config().model_dump_json(),
        str(out.parent / "cache"),
        1,
        1000,
        str(out / ".stages"),
    )
    calls = (*(StageCall(60.0, str(position)) for position in range(3)), StageCall(60.0, ""))
    messages = []
    StageRunner(setup).run_chain(StageChain(row, shard, 0, calls), messages.append)
    part = decode_message(messages[-1]).output
    return SceneResult(row, "done", "pack", attempts=1, part=part)


def start(manifest: Path, out: Path, executor: str = "local", workers: int = 1, **run: object) -> subprocess.Popen[str]:
    """The same build in a process of its own."""
    overrides = [f"run.{key}={value}" for key, value in {**QUICK, **run}.items()]
    command = [
        sys.executable,
        str(HELPERS / "run_build.py"),
        str(manifest),
        str(out),
        executor,
        str(workers),
        *overrides,
    ]
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.Popen(
        command, text=True, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, env=environment, start_new_session=True
    )


def finish(process: subprocess.Popen[str], timeout_s: float = 120.0) -> tuple[int, str]:
    """Exit code and what it wrote."""
    _, errors = process.communicate(timeout=timeout_s)
    return process.returncode, errors


def kill(process: subprocess.Popen[str]) -> None:
    """kill -9 of the driver alone, as a crash would."""
    process.send_signal(signal.SIGKILL)
    process.wait()
    process.stderr.close()


def wait_until(condition, timeout_s: float = 60.0) -> None:
    until = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.02)


def crowd() -> float:
    """Processes that want each CPU, at least 1: limits of time are multiplied by it on a crowded machine."""
    return max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1))


def digests(out: Path) -> dict[str, str]:
    """Sha256 of every file but the timings, what the stages gave and what was spent."""
    apart = {"timings", ".stages", ".spent"}
    files = [path for path in sorted(out.rglob("*")) if path.is_file() and not apart & set(path.parts)]
    return {str(path.relative_to(out)): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def scenes(out: Path) -> list[dict]:
    rows = []
    for path in sorted((out / "scenes").glob("*.parquet")):
        rows += pq.read_table(path).to_pylist()
    return rows
