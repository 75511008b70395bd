"""A sandbox turns every way to die into an outcome, and works on afterwards."""

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import psutil
import pytest

from schemas.config import Config
from schemas.manifest import ImageRow
from schemas.outcome import Dropped, Failed
from schemas.work import SandboxSetup, ScenePart, StageCall, StageChain
from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset.parts import read_part_files, read_part_rows
from tableverse_factory.dataset.tar_members import read_scene_files
from tests.helpers.builds import wait_until
from tests.helpers.paths import ROOT
from workers.sandbox.child import load_pipelines
from workers.sandbox.parent import Sandbox

pytestmark = pytest.mark.heavy


@pytest.fixture
def sandbox(tmp_path):
    made = Sandbox(_setup(tmp_path))
    yield made
    made.close()


def _setup(tmp_path: Path, **changes: object) -> SandboxSetup:
    given = {
        "pipeline": "tests.helpers.tiny_pipeline:PIPELINES",
        "config_json": Config().model_dump_json(),
        "cache_dir": str(tmp_path),
        "attempts": 2,
        "memory_mb": 400,
        "records_dir": str(tmp_path / ".stages"),
    }
    return SandboxSetup(**{**given, **changes})


def _run_line(sandbox: Sandbox, name: str):
    """The report of the last stage that ran, and the place of what the last one that is done gave."""
    report = sandbox.run(_chain(name, range(4)))
    return report.stages[-1], report.output


def _chain(name: str, positions: Sequence[int], deadline_s: float = 60.0, **more: object) -> StageChain:
    """These stages of the tiny pipeline on scene `a`; what they give is kept.

    Only the stage that hangs has a short deadline: on a busy machine each may take seconds.
    """
    row = ImageRow(scene_id="a", kind="capture", uri="/x", name=name)
    deadlines = {position: 1.5 if (name, position) == ("hang", 1) else deadline_s for position in positions}
    calls = tuple(StageCall(deadlines[position], "" if position == 3 else str(position)) for position in positions)
    return StageChain(row, 0, positions[0], calls, **more)


def _children() -> list[psutil.Process]:
    """Sandboxes below this process: other tests may have left servers there."""
    living = [child for child in psutil.Process().children() if child.status() != psutil.STATUS_ZOMBIE]
    return [child for child in living if "workers.sandbox.child" in child.cmdline()]


def _run_one(sandbox: Sandbox, position: int, name: str, *watch, deadline_s: float = 60.0, **more: object):
    """The report of one stage alone, and the place of what it gave."""
    report = sandbox.run(_chain(name, [position], deadline_s, **more), *watch)
    return report.stages[-1], report.output


def test_a_scene_runs_to_its_end(sandbox, tmp_path):
    report, part = _run_line(sandbox, "fine")
    assert report.outcome is None
    assert report.attempts == 1
    assert read_part_rows(tmp_path, 0, part)["scenes"][0]["scene_id"] == "a"
    assert read_scene_files("a", read_part_files(tmp_path, 0, part))["scene.xml"] == b"<mujoco model='a'/>"


def test_a_drop_is_no_failure(sandbox):
    report, place = _run_line(sandbox, "empty")
    assert report.outcome == Dropped("nothing_there", "looked at empty")
    assert place == ""


@pytest.mark.parametrize(
    ("name", "kind", "attempts", "words"),
    [
        ("segfault", "crash", 2, "SIGSEGV"),
        ("exit", "crash", 2, "exit code 3"),
        ("hang", "timeout", 2, "1.5 s"),
        ("hog", "out_of_memory", 2, "400 MB"),
        ("raise", "exception", 1, "KeyError"),
        ("sad", "GeometryError", 1, "give at least 4"),
        ("wrong", "exception", 1, "not an Outcome"),
        ("escape", "BuildError", 1, "no safe name"),
        ("odd_row", "BuildError", 1, "no_such_column"),
    ],
)
def test_every_end_has_its_kind_and_the_next_scene_runs(sandbox, name, kind, attempts, words):
    report, place = _run_line(sandbox, name)
    assert (report.outcome.error_kind, report.attempts) == (kind, attempts)
    assert isinstance(place, str), "no scene"
    assert words in report.outcome.message
    assert _run_line(sandbox, "fine")[0].outcome is None


def test_messages_are_one_line_without_addresses_and_folders(sandbox):
    message = _run_line(sandbox, "raise")[0].outcome.message
    assert "\n" not in message
    assert "0x…" in message
    assert str(ROOT) not in message


def test_a_crash_that_passes_is_done_at_the_second_attempt(sandbox, tmp_path, monkeypatch):
    monkeypatch.setenv("TINY_LINE_MARKS", str(tmp_path))
    place = _look_at(sandbox, "segfault_once")
    sandbox.close()
    report, _ = _run_one(sandbox, 1, "segfault_once", input=place)
    assert report.outcome is None
    assert report.attempts == 2


def test_memory_that_other_scenes_left_behind_is_no_attempt_of_a_scene(tmp_path):
    sandbox = Sandbox(_setup(tmp_path, attempts=1, memory_mb=1000))
    assert _run_line(sandbox, "hoard")[0].outcome is None
    (child,) = _children()
    report, part = _run_line(sandbox, "large")
    assert not child.is_running(), "the scene is too large for this child"
    sandbox.close()
    assert (report.outcome, report.attempts) == (None, 1)
    assert isinstance(part, ScenePart)


@pytest.mark.parametrize("attempts", [pytest.param(1, marks=pytest.mark.slow), 2])  # two include the first
@pytest.mark.parametrize("name", ["hog", *(pytest.param(name, marks=pytest.mark.slow) for name in ("exit", "hang"))])
def test_a_failure_is_the_same_whatever_its_child_ran_before_and_costs_one_run_more(
    tmp_path, monkeypatch, name, attempts
):
    marks = tmp_path / "marks"
    marks.mkdir()
    monkeypatch.setenv("TINY_LINE_MARKS", str(marks))
    sandbox = Sandbox(_setup(tmp_path, attempts=attempts))
    place = _look_at(sandbox, name)

    def run(positions: Sequence[int], place: str) -> tuple[Failed, int, int]:
        (marks / "a.cut").unlink(missing_ok=True)
        report = sandbox.run(_chain(name, positions, input=place)).stages[-1]
        return report.outcome, report.attempts, (marks / "a.cut").stat().st_size

    in_used = run(range(1, 4), place)
    resumed = run(range(1, 4), place)  # the child of the failure is gone
    whole = run(range(4), "")
    sandbox.close()
    assert in_used[:2] == resumed[:2] == whole[:2]
    assert [runs for *_, runs in (resumed, in_used, whole)] == [attempts, attempts + 1, attempts + 1]
    assert resumed[1] == attempts


def test_a_child_killed_from_outside_costs_no_attempt(sandbox):
    place, killed = _look_at(sandbox, "slow_1"), []

    def kill_once():
        children = _children()
        if not killed and children:
            killed.append(children[0].pid)
            os.kill(children[0].pid, signal.SIGKILL)

    report, _ = _run_one(sandbox, 1, "slow_1", kill_once, input=place)
    assert killed
    assert report.outcome is None
    assert report.attempts == 1


def test_the_clock_of_the_deadline_starts_with_the_stage_not_with_the_import(tmp_path):
    sandbox = Sandbox(_setup(tmp_path, attempts=1))
    started = time.monotonic()
    report, _ = _run_one(sandbox, 0, "fine", deadline_s=0.001)
    sandbox.close()
    assert report.wall_s < 0.5 * (time.monotonic() - started), "most of the time is the import"


def test_what_a_stage_defers_is_imported_before_its_clock_starts(tmp_path):
    sandbox = Sandbox(_setup(tmp_path, attempts=1, pipeline="tests.helpers.deferred_pipeline:PIPELINES"))
    report, _ = _run_one(sandbox, 0, "fine", deadline_s=0.9)
    sandbox.close()
    assert report.outcome is None
    assert report.wall_s < 0.9, "its import alone takes a second"


@pytest.mark.parametrize("pipeline", ["no_such_module:PIPELINES", "tests.helpers.deferred_pipeline:MISSING"])
def test_a_pipeline_that_does_not_import_stops_the_build(tmp_path, pipeline):
    with pytest.raises(BuildError, match="no_such_module"):
        _run_one(Sandbox(_setup(tmp_path, pipeline=pipeline)), 0, "fine")


def test_a_stage_whose_module_is_absent_is_found_before_a_build_begins():
    with pytest.raises(BuildError, match=r"no module named 'tests\.helpers\.no_such_module', of stage"):
        load_pipelines("tests.helpers.deferred_pipeline:MISSING")


def test_close_leaves_no_process(sandbox):
    _run_line(sandbox, "fine")
    children = _children()
    assert children
    sandbox.close()
    assert not any(child.is_running() for child in children)


@pytest.mark.parametrize("name", ["leave", "leave_and_exit"])
def test_what_a_child_started_does_not_outlive_it(tmp_path, monkeypatch, name):
    monkeypatch.setenv("TINY_LINE_MARKS", str(tmp_path))
    sandbox = Sandbox(_setup(tmp_path, attempts=1))
    sandbox.run(_chain(name, range(2)))
    pid = int((tmp_path / "left").read_text())
    for child in _children():  # it dies while it is idle, unless it has exited
        child.send_signal(signal.SIGSEGV)
        wait_until(lambda child=child: child.status() == psutil.STATUS_ZOMBIE, 10.0)
    assert _run_line(sandbox, "fine")[0].outcome is None
    wait_until(lambda: not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE, 10.0)
    sandbox.close()


def test_the_child_dies_with_its_parent_even_inside_a_hang(tmp_path):
    script = f"""
import sys; sys.path.insert(0, {str(ROOT)!r})
from pathlib import Path
from tests.workers.sandbox import test_parent as t
from workers.sandbox.channel import Channel
from workers.sandbox.parent import Sandbox
sandbox = Sandbox(t._setup(Path({str(tmp_path)!r}), attempts=1))
place = t._look_at(sandbox, "hang")
print("ready", flush=True)
t._run_one(sandbox, 1, "hang", input=place)
"""
    with subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdout.readline() == "ready\n"
        (child,) = psutil.Process(parent.pid).children()
        time.sleep(0.2)
        parent.kill()
    wait_until(lambda: not child.is_running() or child.status() == psutil.STATUS_ZOMBIE)


def test_children_compute_on_one_thread_with_fixed_hashes(sandbox):
    _run_line(sandbox, "fine")
    (child,) = _children()
    environment = child.environ()
    assert {environment[k] for k in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")} == {"1"}
    assert environment["PYTHONHASHSEED"] == "0"


def _look_at(sandbox: Sandbox, name: str) -> str:
    return _run_one(sandbox, 0, name)[1]


def test_the_trace_of_a_crash_is_found_behind_whatever_was_printed_before(sandbox):
    report, _ = _run_line(sandbox, "chatter")
    assert isinstance(report.outcome, Failed)
    assert report.outcome.error_kind == "crash"
    assert report.trace.startswith("Fatal Python error: Segmentation fault")
    assert "tiny_pipeline" in report.trace


def test_a_crash_in_the_middle_repeats_that_stage_alone(sandbox, tmp_path, monkeypatch):
    marks = tmp_path / "marks"
    marks.mkdir()
    monkeypatch.setenv("TINY_LINE_MARKS", str(marks))
    report = sandbox.run(_chain("segfault_once", range(4)))
    assert [stage.attempts for stage in report.stages] == [1, 1, 1, 1], "its child had run a stage before"
    assert {path.name: path.stat().st_size for path in marks.iterdir()} == {
        "a.look": 1,
        "a.cut": 2,
        "a.settle": 1,
        "a.pack": 1,
    }
    assert isinstance(report.output, ScenePart)


def test_an_input_that_is_gone_is_no_failure_of_the_scene(sandbox):
    report = sandbox.run(_chain("fine", [1], input="shard-00000/a.look.9"))
    assert report.input_lost
    assert (report.stages, report.output) == ((), "")


def test_stages_get_the_same_from_the_stage_before_and_from_a_checkpoint(tmp_path):
    """Between stages of one process nothing is encoded: what a process gave up has to be the same."""
    whole, halves = Sandbox(_setup(tmp_path)), Sandbox(_setup(tmp_path))
    part = whole.run(_chain("fine", range(4))).output
    place = halves.run(_chain("fine", range(2))).output
    other = halves.run(_chain("fine", range(2, 4), input=place)).output
    for read in (read_part_rows, read_part_files):
        assert read(tmp_path, 0, part) == read(tmp_path, 0, other)
    whole.close()
    halves.close()


def test_a_disk_that_refuses_records_stops_the_build_and_names_the_file(tmp_path):
    (tmp_path / ".stages").write_text("a file where the folder should be")
    sandbox = Sandbox(_setup(tmp_path))
    with pytest.raises(BuildError, match=r"cannot write .*stages.*run the same command"):
        _run_one(sandbox, 0, "fine")
    sandbox.close()


def test_code_in_the_folder_where_a_build_is_started_is_not_imported(tmp_path, monkeypatch):
    (tmp_path / "numpy.py").write_text("raise ImportError('a stray file')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    sandbox = Sandbox(_setup(tmp_path))
    assert _run_line(sandbox, "fine")[0].outcome is None
    sandbox.close()


@pytest.mark.parametrize("sent", [signal.SIGKILL, pytest.param(signal.SIGSEGV, marks=pytest.mark.slow)])
def test_a_child_that_dies_while_it_writes_the_scene_has_written_none(tmp_path, sent):
    killed = []

    def kill_while_it_writes() -> None:
        if not killed and any(path.is_file() for path in out.rglob("*.parts")):
            (child,) = _children()
            killed.append(child.pid)
            child.send_signal(sent)

    for number in range(50):  # a fast disk has taken the scene before anybody looks
        out = tmp_path / str(number)
        sandbox = Sandbox(_setup(out, memory_mb=2000))
        report = sandbox.run(_chain("bulky", range(4)), kill_while_it_writes)
        sandbox.close()
        if killed:
            break
        shutil.rmtree(out)
    assert killed
    assert [stage.outcome for stage in report.stages] == [None] * 4
    files = read_scene_files("a", read_part_files(out, 0, report.output))
    assert sum(map(len, files.values())) >= 40_000_000
    assert report.stages[-1].attempts <= 2


def test_a_child_that_dies_while_it_has_nothing_to_do_is_nobodys_fault(tmp_path, monkeypatch):
    monkeypatch.setenv("TINY_LINE_MARKS", str(tmp_path))
    sandbox = Sandbox(_setup(tmp_path, attempts=1))
    assert _run_line(sandbox, "fine")[0].outcome is None
    (child,) = _children()
    child.send_signal(signal.SIGSEGV)
    wait_until(lambda: child.status() == psutil.STATUS_ZOMBIE, 10.0)
    report, _ = _run_line(sandbox, "fine")
    sandbox.close()
    assert (report.outcome, report.attempts) == (None, 1)


def test_records_that_cannot_be_read_stop_the_build(tmp_path):
    sandbox = Sandbox(_setup(tmp_path))
    (tmp_path / ".stages" / "shard-00000" / "odd.pack").mkdir(parents=True)
    with pytest.raises(BuildError, match=r"cannot read .*a\.look\.0"):
        sandbox.run(_chain("fine", [1], input="shard-00000/a.look.0@odd.pack@0"))
    sandbox.close()
