"""One mesh process for many workers: real processes ask, some are killed, and nobody gets other bytes for it."""

import base64
import json
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np
import psutil
import pytest

from tableverse_factory.core.disk_cache import DiskCache
from tableverse_factory.models.local.batch_server import serve_batches
from tableverse_factory.models.local.wire import send_arrays
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.mesh_service.client import MeshClient
from tableverse_factory.stages.place.mesh_service.daemon import MeshDaemon, decode_json, encode_json
from tests.helpers.mesh_client import hashes
from tests.helpers.mesh_daemons import daemons_inside
from tests.helpers.paths import HELPERS, ROOT

pytestmark = pytest.mark.heavy

BAD = 666


BATCH = 32


def command_of(folder: Path, behaviour: str, batch: int = BATCH) -> tuple[str, ...]:
    """The helper's command; the model makes that many objects at a time."""
    variables = f"MESH_LOG={folder / 'log'}", f"MESH_BATCH={batch}"
    return "env", *variables, sys.executable, "-I", str(HELPERS / "mesh_server.py"), behaviour


def noted(folder: Path, what: str = "") -> list[str]:
    path = folder / "log"
    lines = path.read_text().splitlines() if path.exists() else []
    return [line for line in lines if line.startswith(what)]


def wait_until(fulfilled: Callable[[], bool], within_s: float = 20.0) -> None:
    until = time.monotonic() + within_s
    while not fulfilled():
        assert time.monotonic() < until, "too late"
        time.sleep(0.02)


class Worker:
    """A process of its own that asks when it is told to."""

    def __init__(self, folder: Path, name: str) -> None:
        line = [sys.executable, str(HELPERS / "mesh_client.py"), json.dumps(command_of(folder, "gate"))]
        paths = [str(ROOT), os.environ.get("PYTHONPATH", "")]
        self.process = subprocess.Popen(
            [*line, str(folder / "cache"), name],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            cwd=folder,
            env={**os.environ, "XDG_RUNTIME_DIR": str(folder), "PYTHONPATH": os.pathsep.join(paths)},
        )

    def ask(self, *seeds: int) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps(seeds) + "\n")
        self.process.stdin.flush()

    def answer(self) -> list[str]:
        assert self.process.stdout is not None
        found: list[str] = json.loads(self.process.stdout.readline())
        return found

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture
def worker(tmp_path: Path) -> Iterator[Callable[[str], Worker]]:
    workers: list[Worker] = []

    def start(name: str) -> Worker:
        workers.append(Worker(tmp_path, name))
        return workers[-1]

    yield start
    (tmp_path / "log.gate").touch()
    for one in workers:
        one.kill()
        for pipe in (one.process.stdin, one.process.stdout):
            assert pipe is not None
            pipe.close()
    for pid in {int(line.split()[-1]) for line in noted(tmp_path, "start")}:  # its keeper would end within 15 s
        if psutil.pid_exists(pid):
            psutil.Process(pid).parent().parent().kill()


def test_scenes_of_several_workers_go_through_one_process_together(tmp_path, worker, monkeypatch):
    first, second, third = workers = [worker(name) for name in "abc"]
    for seed, one in enumerate(workers):  # all know who answers
        one.ask(seed)
    alone = [one.answer() for one in workers]
    asked = len(noted(tmp_path, "request"))
    first.ask(10, BAD)  # the model works on this one, while others ask
    wait_until(lambda: len(noted(tmp_path, f"make {BAD}")) == 1)
    second.ask(11, 12, 13)
    third.ask(12, 13)
    time.sleep(1.0)
    (tmp_path / "log.gate").touch()
    together = [one.answer() for one in workers]
    assert len({line.split()[-1] for line in noted(tmp_path)}) == 1
    assert [line.rpartition(" ")[0] for line in noted(tmp_path, "request")[asked:]] == ["request of 2", "request of 5"]
    with daemons_inside(monkeypatch):
        maker = MeshClient(command_of(tmp_path, "gate"), 20.0, Services(tmp_path / "other"))
        for name, seed, got in zip("abc", range(3), alone, strict=True):
            assert hashes(maker, name, [seed]) == got
        for name, seeds, got in zip("abc", ([10, BAD], [11, 12, 13], [12, 13]), together, strict=True):
            assert hashes(maker, name, seeds) == got


def test_a_worker_that_is_killed_harms_nobody_and_what_it_asked_for_is_not_lost(tmp_path, worker):
    killed, other = worker("a"), worker("b")
    other.ask(1)
    other.answer()
    killed.ask(10, BAD, 11)
    wait_until(lambda: bool(noted(tmp_path, f"make {BAD}")))
    other.ask(2, 3)
    killed.kill()
    (tmp_path / "log.gate").touch()
    assert all(other.answer())
    again = worker("a")
    again.ask(10, BAD, 11)
    assert all(again.answer())
    assert len(noted(tmp_path, "start")) == 1
    assert len(noted(tmp_path, "make")) == 6, "nothing is made twice"


def build_request(
    folder: Path, daemon: MeshDaemon, name: str, *seeds: int, silence_s: float = 20.0
) -> list[np.ndarray]:
    """What a worker sends that knows who answers."""
    request = {
        "model": daemon.ensure_process().hello.describe_model(),
        "count": len(seeds),
        "cache": str(folder / "kept"),
        "silence_s": silence_s,
        "picture": {"picture": base64.b64encode(name.encode()).decode(), "depth": None, "camera": {}},
        "objects": [{"number": k, "key": f"{name}{k:063d}", "seed": seed, "mask": ""} for k, seed in enumerate(seeds)],
    }
    return list(encode_json(request))


def read_outcomes(answers: Iterable[Sequence[np.ndarray]]) -> list[tuple[list[int], str]]:
    """For each scene the objects that have no mesh, and why it is given up."""
    found = [decode_json(answer) for answer in answers]
    return [(sorted(map(int, answer["reasons"])), answer["given_up"]) for answer in found]


def kept_seeds(folder: Path, name: str, n: int) -> list[int]:
    """For which object each mesh was made that is kept of a scene; of a process that opens its gate."""
    files = DiskCache(folder / "kept", ".json")
    kept = [json.loads(files.get(f"{name}{number:063d}") or b"{}") for number in range(n)]
    return [int(base64.b64decode(entry["data"]).rpartition(b"# ")[2].split()[0]) for entry in kept]


def make_full_folder(folder: Path) -> Path:
    """A folder whose disk keeps nothing."""
    (folder / "full").mkdir()
    (folder / "full" / "kept").touch()
    return folder / "full"


@pytest.fixture
def start_daemon(tmp_path: Path) -> Iterator[Callable[..., MeshDaemon]]:
    kept: list[MeshDaemon] = []

    def start(behaviour: str, batch: int = BATCH) -> MeshDaemon:
        kept.append(MeshDaemon(command_of(tmp_path, behaviour, batch)))
        return kept[-1]

    yield start
    for one in kept:
        one.close()


def test_an_object_that_kills_the_process_costs_no_other_scene_anything(tmp_path, start_daemon):
    one = start_daemon("crash", 1)
    asked = [("a", 1, 2), ("b", 3, BAD, 4), ("c", BAD), ("d", 5, BAD, 1000 + BAD, 2000 + BAD, 6), ("e", 7)]
    answers = read_outcomes(one.answer_scenes([build_request(tmp_path, one, *scene) for scene in asked]))
    assert [missing for missing, _ in answers] == [[], [1], [0], [1, 2, 3], []]
    assert [why.partition(":")[0] for _, why in answers] == [
        *("", ""),
        "the mesh process made none of 1 meshes",
        "at 3 objects in a row the mesh process failed twice",
        "",
    ]
    assert len(noted(tmp_path, "make 6 ")) == 0, "what is given up is not made"
    assert all(len(noted(tmp_path, f"make {seed} ")) == 1 for seed in (1, 2, 3, 4, 5, 7))


def test_many_objects_are_several_requests_and_each_scene_is_told_when_its_own_are_made(tmp_path, start_daemon):
    (tmp_path / "log.gate").touch()
    one = start_daemon("gate")
    asked = [("a", *range(20)), ("b", *range(20, 40)), ("c", *range(40, 75))]
    answers = one.answer_scenes([build_request(tmp_path, one, *scene) for scene in asked])
    next(answers)
    assert 20 <= len(noted(tmp_path, "make")) <= BATCH
    list(answers)
    sizes = [int(line.split()[-2]) for line in noted(tmp_path, "request")]
    assert (max(sizes), sum(sizes), len(sizes)) == (BATCH, 75, 3)


def test_a_scene_is_told_before_the_process_works_on_another_that_is_asked_with_it(tmp_path, start_daemon):
    one = start_daemon("gate", 2)
    answers = one.answer_scenes(
        [build_request(tmp_path, one, "a", 1, 3, silence_s=3.0), build_request(tmp_path, one, "b", 2, BAD)]
    )
    assert read_outcomes([next(answers)]) == [([], "")]
    assert not (tmp_path / "log.gate").exists()
    (tmp_path / "log.gate").touch()
    assert read_outcomes(answers) == [([], "")]
    assert (len(noted(tmp_path, "start")), len(noted(tmp_path, "request"))) == (1, 2)


def test_of_two_scenes_in_a_request_the_more_patient_one_is_heeded(tmp_path, start_daemon):
    one = start_daemon("gate")
    asked = [build_request(tmp_path, one, "a", 1, silence_s=0.2), build_request(tmp_path, one, "b", BAD)]
    opened = threading.Timer(0.8, (tmp_path / "log.gate").touch)
    opened.start()
    assert read_outcomes(one.answer_scenes(asked)) == [([], "")] * 2
    opened.join()
    assert len(noted(tmp_path, "start")) == 1


def test_a_disk_that_refuses_costs_its_own_scene_and_no_other(tmp_path, start_daemon):
    (tmp_path / "log.gate").touch()
    one, full = start_daemon("gate"), make_full_folder(tmp_path)
    asked = [("b", 11, 12), ("c", 21, 22)]
    scenes = [build_request(full, one, "a", 1, 2, 3), *(build_request(tmp_path, one, *scene) for scene in asked)]
    answers = list(one.answer_scenes(scenes))
    refused = [decode_json(answer)["refused"] for answer in answers]
    assert ["Free space" in why for why in refused] == [True, False, False]
    list(one.answer_scenes([build_request(full, one, "a", 1, 2, 3)]))
    assert read_outcomes(one.answer_scenes([build_request(tmp_path, one, "d", 31, 32, 33)])) == [([], "")]
    found = [kept_seeds(tmp_path, name, n) for name, n in (("b", 2), ("c", 2), ("d", 3))]
    assert found == [[11, 12], [21, 22], [31, 32, 33]]
    assert len(noted(tmp_path, "start")) == 1


def test_whatever_ends_a_request_ends_the_process_and_its_answers_with_it(tmp_path):
    calls: list[int] = []

    def heartbeat() -> None:
        calls.append(1)
        if len(calls) == 1:
            raise RuntimeError("stopped in the middle")

    one = MeshDaemon(command_of(tmp_path, "gate"), heartbeat)
    try:
        asked = build_request(tmp_path, one, "a", 1, BAD, 2)
        calls.clear()
        with pytest.raises(RuntimeError, match="in the middle"):
            list(one.answer_scenes([asked]))
        (pid,) = {int(line.split()[-1]) for line in noted(tmp_path)}
        wait_until(lambda: not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE, 5.0)
        (tmp_path / "log.gate").touch()
        assert read_outcomes(one.answer_scenes([build_request(tmp_path, one, "b", 11, 12, 13)])) == [([], "")]
        assert kept_seeds(tmp_path, "b", 3) == [11, 12, 13]
        assert len(noted(tmp_path, "start")) == 2
    finally:
        one.close()


def test_the_same_object_asked_for_by_two_at_once_is_made_once(tmp_path, start_daemon):
    one = start_daemon("well")
    assert (
        read_outcomes(one.answer_scenes([build_request(tmp_path, one, "a", 1, 2) for _ in range(2)])) == [([], "")] * 2
    )
    assert len(noted(tmp_path, "make")) == 2


def test_when_nobody_is_left_the_process_ends_in_the_middle_of_its_work(tmp_path, start_daemon):
    path = tmp_path / "sock"
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen()
    made: list[MeshDaemon] = []

    def make(heartbeat: Callable[[], None]) -> Callable[..., Iterator[list[np.ndarray]]]:
        made.append(MeshDaemon(command_of(tmp_path, "hang"), heartbeat))
        return made[0].answer_scenes

    thread = threading.Thread(target=serve_batches, args=(listener, path, 8, make, 0.3))
    thread.start()
    with socket.socket(socket.AF_UNIX) as end:
        end.connect(str(path))
        wait_until(lambda: bool(made))
        send_arrays(end, build_request(tmp_path, made[0], "a", BAD))
        wait_until(lambda: bool(noted(tmp_path, f"make {BAD}")))
        thread.join(1.5)
        assert thread.is_alive(), "somebody waits"
    thread.join(5.0)
    assert not thread.is_alive()
    assert not path.exists()
    made[0].close()
