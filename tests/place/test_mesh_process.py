"""A mesh process that works, and every way in which one may not: real processes that speak the protocol."""

import os
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
from tableverse_factory.errors import ModelAccessError, ModelError
from tableverse_factory.place import mesh_process
from tableverse_factory.place.mesh_orders import Answer, MeshFile, MeshMaker, Order, View
from tableverse_factory.place.mesh_process import running, stop_all
from tableverse_factory.services import Services

SERVER = Path(__file__).parent / "mesh_server.py"
BAD = 666
VIEW = View(np.zeros((4, 6, 3), np.uint8), np.ones((4, 6), np.float32), Camera(5.0, 5.0, 3.0, 2.0, 6, 4))

Make = Callable[..., list[Answer]]


def command(behaviour: str) -> tuple[str, ...]:
    return sys.executable, "-I", str(SERVER), behaviour


def orders(*seeds: int) -> list[Order]:
    return [Order(VIEW, np.ones((4, 6), bool), seed) for seed in seeds]


@pytest.fixture
def log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[], list[str]]]:
    """What the processes were asked since, without their ids."""
    path = tmp_path / "log"
    monkeypatch.setenv("MESH_LOG", str(path))

    def lines() -> list[str]:
        found = [line.rpartition(" ")[0] for line in path.read_text().splitlines()] if path.exists() else []
        path.unlink(missing_ok=True)
        return found

    yield lines
    stop_all()


@pytest.fixture
def make(tmp_path: Path, log: object) -> Make:
    def ask(behaviour: str, *seeds: int, silence_s: float = 10.0) -> list[Answer]:
        return MeshMaker(command(behaviour), silence_s, Services(tmp_path / "cache")).make(orders(*seeds))[1]

    return ask


def is_made(answer: Answer) -> bool:
    return isinstance(answer, MeshFile) and answer.data.startswith(b"v 0 0 0")


def test_one_process_serves_scene_after_scene_and_nothing_is_made_twice(make: Make, log: Callable[[], list[str]]):
    assert all(map(is_made, make("well", 1, 2)))
    assert log() == ["start", "load", "make 1", "make 2"]
    assert all(map(is_made, make("well", 2, 3)))
    assert log() == ["make 3"]
    stop_all()
    assert all(map(is_made, make("well", 3, 1, 2)))
    assert log() == ["start"], "the weights of a model that has nothing to do need not be loaded"


@pytest.mark.parametrize(
    ("behaviour", "why"),
    [
        ("crash", "exit code 1; it says: RuntimeError: the GPU is on fire"),
        ("hang", "silent for 0.5 s"),
        ("drip", "silent for 0.5 s"),
        ("print", r"its stdout holds b'Load'"),
        ("half", "exit code 0"),
        ("close", "closed its stdin or stdout"),
        ("stranger", "was not asked for"),
        ("no type", "is no answer"),
        ("list", "says not what follows"),
        ("negative", "says not what follows"),
        ("many", "says not what follows"),
        ("gigabyte", "1073741824 bytes; at most 268435456"),
    ],
)
def test_the_object_at_which_a_process_fails_twice_has_none_and_its_neighbours_do(make, log, behaviour, why):
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


def test_an_accident_costs_a_new_process_and_no_object(make: Make, log: Callable[[], list[str]]):
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


def test_what_is_kept_changes_no_result(make: Make):
    cold = make("crash", 1, BAD, 2)
    assert make("crash", 1, BAD, 2) == cold
    make("well", 3, 4)
    mixed = make("crash", 3, BAD, 5, BAD, 4, BAD)
    assert make("crash", 3, BAD, 5, BAD, 4, BAD) == mixed
    assert [is_made(answer) for answer in mixed] == [True, False, True, False, True, False]


def test_a_process_that_fails_at_one_object_after_the_other_is_given_up(make: Make, log: Callable[[], list[str]]):
    with pytest.raises(ModelError, match="at 3 objects in a row the mesh process failed twice: it ended"):
        make("crash", 1, BAD, BAD, BAD, BAD, BAD)
    assert log().count("load") == 4


@pytest.mark.parametrize(
    ("behaviour", "why"),
    [
        (
            "no package",
            "does not start: it ended with exit code 1; it says: ModuleNotFoundError: No module named 'sam3d_",
        ),
        ("other protocol", "does not start: its first message is no hello of protocol 1"),
        ("mute", "does not start: it was silent for 0.5 s"),
        ("no weights", "does not load: it ended with exit code 1; it says: FileNotFoundError: checkpoints"),
    ],
)
def test_a_process_that_cannot_begin_stops_the_build_with_one_line(make, monkeypatch, behaviour, why):
    if behaviour == "mute":
        monkeypatch.setattr(mesh_process, "HELLO_S", 0.5)
    with pytest.raises(ModelAccessError) as caught:
        make(behaviour, 1)
    assert str(caught.value).startswith(f"the mesh process `{sys.executable} -I {SERVER} ")
    assert why in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_program_that_is_not_there_is_named(tmp_path: Path):
    with pytest.raises(ModelAccessError, match=r"it says: /nowhere/python: No such file or directory"):
        MeshMaker(("/nowhere/python", "x.py"), 1.0, Services(tmp_path)).make(orders(1))


def test_a_new_version_of_a_model_is_asked_again_and_a_seed_counts_only_where_it_is_wanted(tmp_path, log, monkeypatch):
    script = tmp_path / "server.py"
    for version, wants, seed, asked in (("1", "seed", 1, 1), ("2", "seed", 1, 1), ("2", "seed", 2, 1)):
        script.write_text(SERVER.read_text().replace('"version": "1"', f'"version": "{version}"'))
        stop_all()
        MeshMaker((sys.executable, str(script), "well"), 9.0, Services(tmp_path)).make(orders(seed))
        assert sum(line.startswith("make") for line in log()) == asked, (version, wants, seed)
    script.write_text(SERVER.read_text().replace('"wants": ["seed"]', '"wants": []'))
    stop_all()
    for seed, asked in ((1, 1), (2, 0)):
        MeshMaker((sys.executable, str(script), "well"), 9.0, Services(tmp_path)).make(orders(seed))
        assert sum(line.startswith("make") for line in log()) == asked


def test_a_chatty_process_fills_neither_the_disk_nor_the_memory_and_never_waits(make: Make):
    for seed in range(3):
        make("chatter", seed)
    process = running(command("chatter"))
    assert str(Path(f"/proc/{process._process.pid}/fd/2").readlink()).startswith("pipe:")
    assert len(process._said._end) <= 1 << 16


def test_a_process_sees_neither_the_ways_to_our_modules_nor_keys(tmp_path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PYTHONPATH", "/ours")
    monkeypatch.setenv("A_KEY", "sk-hush")
    monkeypatch.setenv("HF_TOKEN", "hf-hush")
    monkeypatch.setenv("HOME", "/home/own")
    tell = ("sh", "-c", 'echo "[$A_KEY] [$HF_TOKEN] [$PYTHONPATH] [$HOME]" >&2; exit 1')
    with pytest.raises(ModelAccessError, match=r"it says: \[\] \[\] \[\] \[/home/own\]"):
        MeshMaker(tell, 1.0, Services(tmp_path)).make(orders(1))


def test_ending_it_ends_what_it_started(tmp_path: Path, log: object):
    line = f"{sys.executable} {SERVER} hang; true"  # a shell that stays, as wrappers of environments do
    process = running(("sh", "-c", line))
    below = psutil.Process(process._process.pid).children(recursive=True)
    assert below
    stop_all()
    assert not psutil.wait_procs(below, timeout=5.0)[1]


def test_what_is_below_a_launcher_that_is_killed_alone_is_killed(log: object):
    line = f"{sys.executable} {SERVER} 'stuck'; true"
    process = running(("sh", "-c", line))
    below = psutil.Process(process._process.pid).children(recursive=True)
    assert len(below) == 2
    os.kill(process._process.pid, signal.SIGKILL)
    process._process.wait()
    assert running(("sh", "-c", line)) is not process
    assert not psutil.wait_procs(below, timeout=5.0)[1]


@pytest.mark.parametrize("wrapped", [False, True])
def test_it_dies_with_a_parent_that_is_killed(wrapped: bool, tmp_path: Path):
    deploy = SERVER.parents[2] / "deploy" / "mesh" / "triposr.py"
    started = ["sh", "-c", f"{sys.executable} {deploy} --self-test; true"] if wrapped else [sys.executable, str(deploy)]
    code = (
        "import sys, time\nfrom tableverse_factory.place.mesh_process import running\n"
        f"print(running(tuple({[*started, '--self-test']!r}))._process.pid, flush=True)\ntime.sleep(100)\n"
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
