"""A mesh process that works, and every way in which one may not: real processes that speak the protocol."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import psutil
import pytest

from schemas.geometry import Camera
from tableverse_factory.core.errors import ModelAccessError, ModelError
from tableverse_factory.models.local import model_daemon
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.mesh_service import client
from tableverse_factory.stages.place.mesh_service import process as process_module
from tableverse_factory.stages.place.mesh_service.client import MeshAnswer, MeshClient, MeshFile, MeshQuery, RgbdImage
from tableverse_factory.stages.place.mesh_service.daemon import MeshDaemon, build_spec
from tableverse_factory.stages.place.mesh_service.process import MeshProcess
from tests.helpers.mesh_daemons import daemons_inside
from tests.helpers.paths import HELPERS

pytestmark = pytest.mark.heavy

SERVER = HELPERS / "mesh_server.py"
BAD = 666
VIEW = RgbdImage(np.zeros((4, 6, 3), np.uint8), np.ones((4, 6), np.float32), Camera(5.0, 5.0, 3.0, 2.0, 6, 4))

Make = Callable[..., list[MeshAnswer]]
Log = Callable[[], list[str]]
Daemons = dict[tuple[str, ...], MeshDaemon]


def orders(*seeds: int) -> list[MeshQuery]:
    return [MeshQuery(np.ones((4, 6), bool), seed) for seed in seeds]


@pytest.fixture
def log(tmp_path: Path) -> Log:
    """What the processes were asked since, without their ids."""
    path = tmp_path / "log"

    def lines() -> list[str]:
        found = [line.rpartition(" ")[0] for line in path.read_text().splitlines()] if path.exists() else []
        path.unlink(missing_ok=True)
        return found

    return lines


@pytest.fixture
def command(tmp_path: Path) -> Callable[..., tuple[str, ...]]:
    def line(behaviour: str, server: Path = SERVER) -> tuple[str, ...]:
        return "env", f"MESH_LOG={tmp_path / 'log'}", sys.executable, "-I", str(server), behaviour

    return line


@pytest.fixture(autouse=True)
def daemons(monkeypatch: pytest.MonkeyPatch) -> Iterator[Daemons]:
    with daemons_inside(monkeypatch) as found:
        yield found


@pytest.fixture
def make(tmp_path: Path, command: Callable[[str], tuple[str, ...]]) -> Make:
    def ask(behaviour: str, *seeds: int, silence_s: float = 10.0) -> list[MeshAnswer]:
        maker = MeshClient(command(behaviour), silence_s, Services(tmp_path / "cache"))
        return maker.make_meshes(VIEW, orders(*seeds))

    return ask


@pytest.fixture
def process() -> Iterator[Callable[..., MeshProcess]]:
    started: list[MeshProcess] = []

    def start(*line: str) -> MeshProcess:
        started.append(MeshProcess(line))
        return started[-1]

    yield start
    for one in started:
        one.close()


def end_all(daemons: Daemons) -> None:
    """As when all workers have gone and other ones come."""
    while daemons:
        daemons.popitem()[1].close()
    client._MODEL_CACHE.clear()


def is_made(answer: MeshAnswer) -> bool:
    return isinstance(answer, MeshFile) and answer.data.startswith(b"v 0 0 0")


def test_one_process_serves_scene_after_scene_and_nothing_is_made_twice(make: Make, log: Log, daemons: Daemons):
    assert all(map(is_made, make("well", 1, 2)))
    assert log() == ["start", "load", "make 1", "make 2"]
    assert all(map(is_made, make("well", 2, 3)))
    assert log() == ["make 3"]
    end_all(daemons)
    assert all(map(is_made, make("well", 3, 1, 2)))
    assert log() == ["start"], "the weights of a model that has nothing to do need not be loaded"


@pytest.mark.parametrize(
    ("behaviour", "why"),
    [
        ("crash", "exit code 1; it says: RuntimeError: the GPU is on fire"),
        ("hang", "silent for 0.5 s"),
        pytest.param("drip", "silent for 0.5 s", marks=pytest.mark.slow),
        pytest.param("half", "exit code 0", marks=pytest.mark.slow),
        pytest.param("close", "the connection failed: RemoteProtocolError", marks=pytest.mark.slow),
        ("refuse", "it knows no model 'tetra' at this address (HTTP 404)"),
        pytest.param("list", "no whole JSON object", marks=pytest.mark.slow),
        pytest.param("nothing", "not as many 'meshes' as objects", marks=pytest.mark.slow),
        pytest.param("too many", "not as many 'meshes' as objects", marks=pytest.mark.slow),
        ("no entry", "neither 'data' nor 'error'"),
        pytest.param("no data", "neither 'data' nor 'error'", marks=pytest.mark.slow),
        ("not base64", "not in base64"),
        ("long", "longer than 90000 bytes"),
    ],
)
def test_the_object_at_which_a_process_fails_twice_has_none_and_its_neighbours_do(
    make, log, monkeypatch, behaviour, why
):
    monkeypatch.setattr(process_module, "MAX_ANSWER_BYTES", 90_000)
    before, bad, after = make(behaviour, 1, BAD, 2, silence_s=0.5)
    assert is_made(before)
    assert is_made(after)
    assert isinstance(bad, str)
    assert bad.startswith("the mesh process failed twice: ")
    assert why in bad
    assert "\n" not in bad
    asked = log()
    assert asked.count("start") == asked.count("load") == 3
    assert asked.count("make 1") == 1
    assert asked.count(f"make {BAD}") == 2


def test_an_accident_costs_a_new_process_and_no_object(make: Make, log: Log):
    assert all(map(is_made, make("crash once", 1, BAD, 2)))
    assert log().count("load") == 2


def test_what_the_model_says_of_an_object_is_one_bounded_line_and_the_process_stays(make, log):
    before, bad, after = make("fail", 1, BAD, 2)
    assert is_made(before)
    assert is_made(after)
    assert bad.startswith("the model has no mesh: nothing in the mask \\x1b[31m\\n")
    assert len(bad) < 400
    assert log().count("start") == 1


def test_a_mesh_without_an_up_axis_is_refused(make: Make):
    assert make("no up", 1, BAD)[1] == ("its mesh names no format of glb, obj, ply, stl with an up axis of y or z")


def test_a_scene_for_which_nothing_was_made_fails_and_is_not_left_empty(make: Make):
    with pytest.raises(
        ModelError, match=r"the mesh process made none of 1 meshes: the mesh process failed twice: it ended .* on fire"
    ):
        make("crash", BAD)


@pytest.mark.slow  # asks for twenty objects, of processes that crash
def test_what_is_kept_changes_no_result(make: Make):
    cold = make("crash", 1, BAD, 2)
    assert make("crash", 1, BAD, 2) == cold
    make("well", 3, 4)
    mixed = make("crash", 3, BAD, 5, 1000 + BAD, 4, 2000 + BAD)
    assert make("crash", 3, BAD, 5, 1000 + BAD, 4, 2000 + BAD) == mixed
    assert [is_made(answer) for answer in mixed] == [True, False, True, False, True, False]


def test_a_process_that_fails_at_one_object_after_the_other_is_given_up(make: Make, log: Log):
    with pytest.raises(ModelError, match="at 3 objects in a row the mesh process failed twice: it ended"):
        make("crash", 1, *(1000 * k + BAD for k in range(5)))
    assert log().count("load") == 6


@pytest.mark.parametrize(
    ("behaviour", "why"),
    [
        (
            "no package",
            "does not start: it ended with exit code 1; it says: ModuleNotFoundError: No module named 'sam3d_",
        ),
        ("other protocol", "does not start: its first message is no hello of protocol 2: protocol: Input should be 2"),
        ("elsewhere", "no hello of protocol 2: url: Value error, is no http:// address of this machine"),
        ("unnamed", "no hello of protocol 2: model: String should have at least 1 character"),
        ("mute", "does not start: it was silent for 0.5 s"),
        ("no weights", "does not load: it ended with exit code 1; it says: FileNotFoundError: checkpoints"),
    ],
)
def test_a_process_that_cannot_begin_stops_the_build_with_one_line(make, monkeypatch, behaviour, why):
    if behaviour == "mute":
        monkeypatch.setattr(process_module, "HELLO_S", 0.5)
    with pytest.raises(ModelAccessError) as caught:
        make(behaviour, 1)
    assert str(caught.value).startswith("the mesh process `env MESH_LOG=")
    assert why in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_program_that_is_not_there_is_named(tmp_path: Path):
    with pytest.raises(ModelAccessError, match=r"it says: /nowhere/python: No such file or directory"):
        MeshClient(("/nowhere/python", "x.py"), 1.0, Services(tmp_path)).make_meshes(VIEW, orders(1))


def test_a_new_version_of_a_model_is_asked_again_and_a_seed_counts_only_where_it_is_wanted(
    tmp_path, log, command, daemons
):
    script = tmp_path / "server.py"
    maker = MeshClient(command("well", script), 9.0, Services(tmp_path))
    for version, wants, seed, asked in (("1", "seed", 1, 1), ("2", "seed", 1, 1), ("2", "seed", 2, 1)):
        script.write_text(SERVER.read_text().replace('"version": "1"', f'"version": "{version}"'))
        end_all(daemons)
        maker.make_meshes(VIEW, orders(seed))
        assert sum(line.startswith("make") for line in log()) == asked, (version, wants, seed)
    script.write_text(SERVER.read_text().replace('"wants": ["seed"]', '"wants": []'))
    end_all(daemons)
    for seed, asked in ((1, 1), (2, 0)):
        maker.make_meshes(VIEW, orders(seed))
        assert sum(line.startswith("make") for line in log()) == asked


def test_a_worker_that_knows_an_earlier_version_is_told_and_gets_what_the_new_one_makes(
    tmp_path, log, command, daemons
):
    script = tmp_path / "server.py"
    maker = MeshClient(command("well", script), 9.0, Services(tmp_path))
    for version in ("1", "2"):
        script.write_text(SERVER.read_text().replace('"version": "1"', f'"version": "{version}"'))
        assert all(map(is_made, maker.make_meshes(VIEW, orders(1 + int(version)))))
        assert client._MODEL_CACHE[json.dumps(build_spec(command("well", script)))]["version"] == version
        daemons.popitem()[1].close()
    assert log().count("make 3") == 1


def test_a_process_that_is_another_one_after_its_death_gives_nothing_under_the_first_ones_name(tmp_path, command, log):
    script = tmp_path / "server.py"
    version = '"version": str(Path(os.environ["MESH_LOG"]).with_suffix(".flag").exists())'
    script.write_text(SERVER.read_text().replace('"version": "1"', version))
    maker = MeshClient(command("crash once", script), 9.0, Services(tmp_path))
    assert all(map(is_made, maker.make_meshes(VIEW, orders(1, BAD))))
    assert client._MODEL_CACHE[json.dumps(build_spec(command("crash once", script)))]["version"] == "True"
    assert [line for line in log() if line.startswith("make")] == ["make 1", f"make {BAD}", "make 1", f"make {BAD}"]


def test_who_empties_the_cache_meanwhile_costs_another_question_and_not_the_scene(tmp_path, make, log, monkeypatch):
    ask, emptied = client.request_meshes, []

    def then_empty(line, question):
        answer = ask(line, question)
        if question["objects"] and len(emptied) < times:
            emptied.append(1)
            shutil.rmtree(tmp_path / "cache")
        return answer

    monkeypatch.setattr(client, "request_meshes", then_empty)
    times = 1
    assert all(map(is_made, make("well", 1, 2)))
    assert log().count("make 1") == 2
    times = 100
    with pytest.raises(ModelError, match="cached meshes disappear"):
        make("well", 3)


def test_a_chatty_process_fills_neither_the_disk_nor_the_memory_and_never_waits(make: Make, daemons: Daemons):
    for seed in range(3):
        make("chatter", seed)
    ((_, daemon),) = daemons.items()
    process = daemon._process
    assert process is not None
    assert str(Path(f"/proc/{process._process.pid}/fd/2").readlink()).startswith("pipe:")
    assert process.output.read_last_line() == "step 1/25"


def test_a_process_knows_where_things_are_and_nothing_else_of_ours(tmp_path, monkeypatch: pytest.MonkeyPatch):
    for name in ("PYTHONPATH", "A_KEY", "HF_TOKEN", "AWS_PROFILE", "HTTPS_PROXY", "DATABASE_URL"):
        monkeypatch.setenv(name, "hush")
    for name in ("HF_PAT", "HF_HUB_AUTH", "TRANSFORMERS_PWD", "XDG_SESSION_COOKIE", "CONDA_CHANNELS", "CUDA_PAT"):
        monkeypatch.setenv(name, "hush")
    monkeypatch.setenv("HF_ENDPOINT", "https://user:hush@mirror.example")
    monkeypatch.setenv("HOME", "/home/own")
    monkeypatch.setenv("HF_HOME", "/hf")
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "1")
    tell = (
        "env",
        "OWN=1",
        "sh",
        "-c",
        'echo "$(env | grep hush) $HOME $HF_HOME $CUDA_VISIBLE_DEVICES $OWN" >&2; exit 1',
    )
    with pytest.raises(ModelAccessError, match=r"it says: /home/own /hf 1 1$"):
        MeshClient(tell, 1.0, Services(tmp_path)).make_meshes(VIEW, orders(1))
    monkeypatch.setenv("HF_ENDPOINT", "https://mirror.example")
    assert process_module.select_environment()["HF_ENDPOINT"] == "https://mirror.example"


def test_the_same_words_elsewhere_are_another_process(tmp_path, monkeypatch: pytest.MonkeyPatch, daemons: Daemons):
    command, found = (sys.executable, "-m", "own_server", "well"), []
    for name in ("one", "two"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "own_server.py").write_text(SERVER.read_text().replace('"tetra"', f'"{name}"'))
        monkeypatch.chdir(tmp_path / name)
        (answer,) = MeshClient(command, 9.0, Services(tmp_path)).make_meshes(VIEW, orders(1))
        assert isinstance(answer, MeshFile)
        found.append(answer.model)
        daemons.popitem()[1].close()
    assert found == ["one@1", "two@1"]


def test_a_daemon_is_shared_from_one_folder_with_one_environment(tmp_path, monkeypatch: pytest.MonkeyPatch):
    def address() -> Path:
        return model_daemon.compute_socket_path("daemon", build_spec(("meshserver", "well")))

    here = address()
    monkeypatch.setenv("SOME_TOKEN", "not passed on")
    assert address() == here
    monkeypatch.setenv("PATH", f"{tmp_path}:{os.environ['PATH']}")
    other = address()
    monkeypatch.chdir(tmp_path)
    assert len({here, other, address()}) == 3


def test_a_cache_that_cannot_be_written_is_told_to_who_named_it(tmp_path, command):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "meshes").touch()
    with pytest.raises(ModelAccessError, match=r"meshes cannot be kept in .*: Not a directory"):
        MeshClient(command("well"), 9.0, Services(tmp_path / "full")).make_meshes(VIEW, orders(1))


def test_ending_it_ends_what_it_started(process: Callable[..., MeshProcess]):
    one = process("sh", "-c", f"{sys.executable} {SERVER} hang; true")  # a shell that stays, as wrappers do
    below = psutil.Process(one._process.pid).children(recursive=True)
    assert below
    one.close()
    assert not psutil.wait_procs(below, timeout=5.0)[1]


def test_what_is_below_a_launcher_that_is_killed_alone_is_killed(daemons: Daemons):
    line = ("sh", "-c", f"{sys.executable} {SERVER} 'stuck'; true")
    daemon = daemons[line] = MeshDaemon(line)
    process = daemon.ensure_process()
    below = psutil.Process(process._process.pid).children(recursive=True)
    assert len(below) == 2
    os.kill(process._process.pid, signal.SIGKILL)
    process._process.wait()
    assert daemon.ensure_process() is not process
    assert not psutil.wait_procs(below, timeout=5.0)[1]


@pytest.mark.parametrize("wrapped", [False, True])
def test_it_dies_with_a_parent_that_is_killed(wrapped: bool, tmp_path: Path):
    deploy = SERVER.parents[2] / "deploy" / "mesh" / "triposr.py"
    started = ["sh", "-c", f"{sys.executable} {deploy} --self-test; true"] if wrapped else [sys.executable, str(deploy)]
    code = (
        "import sys, time\nfrom tableverse_factory.stages.place.mesh_service.process import MeshProcess\n"
        f"kept = MeshProcess(tuple({[*started, '--self-test']!r}))\nprint(kept._process.pid, flush=True)\n"
        "time.sleep(100)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, cwd=SERVER.parents[2])
    assert parent.stdout is not None
    top = psutil.Process(int(parent.stdout.readline()))
    below = [top, *top.children(recursive=True)]
    assert len(below) == 2 + wrapped
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    parent.stdout.close()
    until = time.monotonic() + 5.0
    while any(process.is_running() and process.status() != psutil.STATUS_ZOMBIE for process in below):
        assert time.monotonic() < until, "orphaned"
        time.sleep(0.02)
