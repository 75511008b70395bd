"""Ray nodes for the tests: real `ray start` processes of their own, with their own ports, folders and token."""

import os
import shutil
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest

from tests.helpers.builds import write_manifest
from tests.helpers.processes import kill_if_alive

BIN = Path(sys.executable).parent
START_S = 120.0
TINY = f"""#!{sys.executable}
import workers.run
workers.run.PIPELINE = "tests.helpers.tiny_pipeline:PIPELINES"
from tableverse_factory.cli.main import main
main()
"""


@dataclass(frozen=True)
class Head:
    """A running head: where its jobs and its store listen, what a client's environment needs, and its folder."""

    jobs: str
    address: str
    environment: dict[str, str]
    folder: Path


def write_seen_manifest(path: Path, names: list[str]) -> Path:
    """A manifest for the tiny pipeline whose inputs are there: a cluster refuses one whose inputs it cannot see."""
    for i in range(len(names)):
        (path.parent / "in" / str(i)).mkdir(parents=True)
    return write_manifest(path, names, str(path.parent / "in"))


def tiny_tableverse(folder: Path) -> Path:
    """A folder with a command `tableverse` that runs the tiny pipeline; the rest of the command line is real."""
    folder.mkdir(exist_ok=True)
    (folder / "tableverse").write_text(TINY)
    (folder / "tableverse").chmod(0o700)
    return folder


def clean_environment(**changes: str) -> dict[str, str]:
    """This environment without what would lead to somebody else's cluster."""
    kept = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}
    single = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "RAY_USAGE_STATS_ENABLED": "0"}
    return {**kept, **single, "PATH": f"{BIN}:{kept['PATH']}", **changes}


@contextmanager
def ray_head(cpus: int = 2, **environment: str) -> Iterator[Head]:
    """A head with a dashboard on loopback and token authentication; everything it started is gone afterwards."""
    folder = Path(tempfile.mkdtemp(prefix="tv-ray-"))  # short: names of sockets have 107 characters at most
    token = folder / "token"
    token.write_text("5c3a" * 16)
    token.chmod(0o600)
    keys = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN_PATH": str(token)}
    store, dashboard, client = free_ports(3)
    options = ["--head", f"--port={store}", "--dashboard-host=127.0.0.1", f"--dashboard-port={dashboard}"]
    options += ["--include-dashboard=true", f"--ray-client-server-port={client}"]
    try:
        with ray_node(folder / "head", options, cpus, clean_environment(**keys, **environment)) as process:
            _wait_for(lambda: listens(dashboard), process, folder / "head")
            yield Head(f"http://127.0.0.1:{dashboard}", f"127.0.0.1:{store}", keys, folder)
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def ray_node(
    folder: Path, options: list[str], cpus: int, environment: dict[str, str], before: Sequence[str] = ()
) -> Iterator[subprocess.Popen]:
    """A node while the block lasts: its `ray start` process, below which all others are; started by `before`."""
    folder.mkdir(parents=True)
    agent, metrics, runtime = free_ports(3)
    command = [
        *before,
        str(BIN / "ray"),
        "start",
        "--block",
        "--disable-usage-stats",
        "--node-ip-address=127.0.0.1",
        *options,
    ]
    command += [f"--num-cpus={cpus}", "--object-store-memory=100000000", "--min-worker-port=0", "--max-worker-port=0"]
    command += [f"--dashboard-agent-listen-port={agent}", f"--metrics-export-port={metrics}"]
    command += [f"--runtime-env-agent-port={runtime}"]
    if "--head" in options:
        command.append(f"--temp-dir={folder}")
    with (folder / "start.log").open("wb") as log:
        process = subprocess.Popen(
            command,
            env=environment,
            cwd=folder,
            stdout=log,
            stderr=log,
            stdin=subprocess.DEVNULL,
            start_new_session=True,
        )
    try:
        _wait_for(lambda: "runtime started" in (folder / "start.log").read_text(), process, folder)
        yield process
    finally:
        end(process)


def end(process: subprocess.Popen) -> None:
    """Ends a process and all below it, whatever state they are in."""
    try:
        family = psutil.Process(process.pid).children(recursive=True)
    except psutil.NoSuchProcess:
        family = []
    process.terminate()
    psutil.wait_procs(family, timeout=5.0)
    for member in family:
        kill_if_alive(member)
    process.kill()
    process.wait()


def without(folder: Path) -> list[str]:
    """Words before a command that hide the folder from it and all below it."""
    script = 'mount -t tmpfs none "$0" && exec "$@"'
    words = ["unshare", "--map-root-user", "--mount", "sh", "-c", script, str(folder)]
    if subprocess.run([*words, "true"], check=False, capture_output=True).returncode:
        pytest.skip("this kernel lets no process have mounts of its own")
    return words


def actors_below(node: int) -> list[psutil.Process]:
    """Actors that live below a process."""
    found = []
    for process in psutil.Process(node).children(recursive=True):
        with suppress(psutil.Error):  # it ended while we looked
            if any("StageActor" in word for word in process.cmdline()):
                found.append(process)
    return found


def free_ports(n: int) -> list[int]:
    """Ports that nobody listens on now."""
    sockets = [socket.socket() for _ in range(n)]
    for each in sockets:
        each.bind(("127.0.0.1", 0))
    ports = [each.getsockname()[1] for each in sockets]
    for each in sockets:
        each.close()
    return ports


def listens(port: int) -> bool:
    """Whether somebody does."""
    try:
        socket.create_connection(("127.0.0.1", port), timeout=1.0).close()
    except OSError:
        return False
    return True


def _wait_for(condition: Callable[[], bool], process: subprocess.Popen, folder: Path) -> None:
    until = time.monotonic() + START_S
    while not condition():
        said = (folder / "start.log").read_text()[-2000:]
        assert process.poll() is None, said
        assert time.monotonic() < until, said
        time.sleep(0.2)
