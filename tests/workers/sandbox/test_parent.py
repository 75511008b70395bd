"""A sandbox turns every way to die into an outcome, and works on afterwards."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import psutil
import pytest

from schemas.codec import decode, encode
from schemas.config import Config
from schemas.manifest import ImageRow
from schemas.outcome import Dropped, Failed
from schemas.work import SandboxSetup, StageCall, StageChain
from tableverse_factory.core.errors import BuildError
from tests.helpers.builds import wait_until
from tests.helpers.paths import ROOT
from workers.sandbox.channel import Channel
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
        "records_dir": str(tmp_path / "records"),
    }
    return SandboxSetup(**{**given, **changes})


def _run_line(sandbox: Sandbox, name: str):
    """The report of the last stage that ran, and what it gave."""
    item = encode(ImageRow(scene_id="a", kind="capture", uri="/x", name=name))
    report, value = sandbox.run(_chain(range(4)), item)
    return report.stages[-1], value


def _chain(positions: Sequence[int], deadline_s: float = 3.0) -> StageChain:
    """These stages of the tiny pipeline on scene `a`; what they give is kept."""
    calls = tuple(StageCall("a", "capture", position, deadline_s) for position in positions)
    return StageChain(calls, "", tuple(f"shard-00000/a.{position}.0" for position in positions))


def _children() -> list[psutil.Process]:
    """Sandboxes below this process: other tests may have left servers there."""
    living = [child for child in psutil.Process().children() if child.status() != psutil.STATUS_ZOMBIE]
    return [child for child in living if "workers.sandbox.child" in child.cmdline()]


def _run_one(sandbox: Sandbox, position: int, item: bytes, *watch, deadline_s: float = 3.0):
    """The report of one stage alone, and what it gave."""
    report, value = sandbox.run(_chain([position], deadline_s), item, *watch)
    return report.stages[-1], value


def test_a_scene_runs_to_its_end(sandbox):
    report, item = _run_line(sandbox, "fine")
    assert report.outcome is None
    assert report.attempts == 1
    assert dict(decode(item).files)["scene.xml"] == b"<mujoco model='a'/>"


def test_a_drop_is_no_failure(sandbox):
    report, item = _run_line(sandbox, "empty")
    assert report.outcome == Dropped("nothing_there", "looked at empty")
    assert item == b""


@pytest.mark.parametrize(
    ("name", "kind", "attempts", "words"),
    [
        ("segfault", "crash", 2, "SIGSEGV"),
        ("exit", "crash", 2, "exit code 3"),
        ("hang", "timeout", 2, "3 s"),
        ("hog", "out_of_memory", 2, "400 MB"),
        ("raise", "exception", 1, "KeyError"),
        ("sad", "GeometryError", 1, "give at least 4"),
        ("wrong", "exception", 1, "not an Outcome"),
        ("escape", "BuildError", 1, "no safe name"),
        ("odd_row", "BuildError", 1, "no_such_column"),
    ],
)
def test_every_end_has_its_kind_and_the_next_scene_runs(sandbox, name, kind, attempts, words):
    report, item = _run_line(sandbox, name)
    assert (report.outcome.error_kind, report.attempts, item) == (kind, attempts, b"")
    assert words in report.outcome.message
    assert _run_line(sandbox, "fine")[0].outcome is None


def test_messages_are_one_line_without_addresses_and_folders(sandbox):
    message = _run_line(sandbox, "raise")[0].outcome.message
    assert "\n" not in message
    assert "0x…" in message
    assert str(ROOT) not in message


def test_a_crash_that_passes_is_done_at_the_second_attempt(sandbox, tmp_path, monkeypatch):
    monkeypatch.setenv("TINY_LINE_MARKS", str(tmp_path))
    report, _ = _run_one(sandbox, 1, _looked_at(sandbox, "segfault_once"))
    assert report.outcome is None
    assert report.attempts == 2


def test_a_child_killed_from_outside_costs_no_attempt(sandbox):
    item = _looked_at(sandbox, "slow_1")
    killed = []

    def kill_once():
        children = _children()
        if not killed and children:
            killed.append(children[0].pid)
            os.kill(children[0].pid, signal.SIGKILL)

    report, _ = _run_one(sandbox, 1, item, kill_once)
    assert killed
    assert report.outcome is None
    assert report.attempts == 1


def test_the_clock_of_the_deadline_starts_with_the_stage_not_with_the_import(tmp_path):
    sandbox = Sandbox(_setup(tmp_path, attempts=1))
    started = time.monotonic()
    report, _ = _run_one(sandbox, 0, b"no message", deadline_s=0.001)
    sandbox.close()
    assert report.wall_s < 0.5 * (time.monotonic() - started), "most of the time is the import"


def test_a_pipeline_that_does_not_import_stops_the_build(tmp_path):
    with pytest.raises(BuildError, match="no_such_module"):
        _run_one(Sandbox(_setup(tmp_path, pipeline="no_such_module:PIPELINES")), 0, b"")


def test_close_leaves_no_process(sandbox):
    _run_line(sandbox, "fine")
    children = _children()
    assert children
    sandbox.close()
    assert not any(child.is_running() for child in children)


def test_the_child_dies_with_its_parent_even_inside_a_hang(tmp_path):
    script = f"""
import sys; sys.path.insert(0, {str(ROOT)!r})
from pathlib import Path
from tests.workers.sandbox import test_parent as t
from workers.sandbox.channel import Channel
from workers.sandbox.parent import Sandbox
sandbox = Sandbox(t._setup(Path({str(tmp_path)!r}), attempts=1))
item = t._looked_at(sandbox, "hang")
print("ready", flush=True)
t._run_one(sandbox, 1, item, deadline_s=60.0)
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


def _looked_at(sandbox: Sandbox, name: str) -> bytes:
    item = encode(ImageRow(scene_id="a", kind="capture", uri="/x", name=name))
    return _run_one(sandbox, 0, item)[1]


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
    item = encode(ImageRow(scene_id="a", kind="capture", uri="/x", name="segfault_once"))
    report, value = sandbox.run(_chain(range(4)), item)
    assert [stage.attempts for stage in report.stages] == [1, 2, 1, 1]
    assert {path.name: path.stat().st_size for path in marks.iterdir()} == {
        "a.look": 1,
        "a.cut": 2,
        "a.settle": 1,
        "a.pack": 1,
    }
    assert decode(value).scene_id == "a"


def test_a_chain_whose_records_are_not_kept_begins_again(tmp_path, monkeypatch):
    monkeypatch.setenv("TINY_LINE_MARKS", str(tmp_path))
    sandbox = Sandbox(_setup(tmp_path))
    item = encode(ImageRow(scene_id="a", kind="capture", uri="/x", name="segfault_once"))
    report, value = sandbox.run(replace(_chain(range(4)), output_records=("",) * 4), item)
    sandbox.close()
    assert [stage.attempts for stage in report.stages] == [2, 2, 1, 1]
    assert decode(value).scene_id == "a"


def test_an_input_that_is_gone_is_no_failure_of_the_scene(sandbox):
    report, value = sandbox.run(replace(_chain([1]), input_record="shard-00000/a.0.9"), b"")
    assert report.input_lost
    assert (report.stages, value) == ((), b"")


def test_a_disk_that_refuses_records_stops_the_build_and_names_the_file(tmp_path):
    (tmp_path / "records").write_text("a file where the folder should be")
    sandbox = Sandbox(_setup(tmp_path))
    with pytest.raises(BuildError, match=r"cannot write .*records.*run the same command"):
        _run_one(sandbox, 0, encode(ImageRow(scene_id="a", kind="capture", uri="/x", name="fine")))
    sandbox.close()


def test_code_in_the_folder_where_a_build_is_started_is_not_imported(tmp_path, monkeypatch):
    (tmp_path / "numpy.py").write_text("raise ImportError('a stray file')")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    sandbox = Sandbox(_setup(tmp_path))
    assert _run_line(sandbox, "fine")[0].outcome is None
    sandbox.close()


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGSEGV])
def test_a_child_that_dies_while_it_hands_over_its_last_answer_has_given_none(tmp_path, monkeypatch, sent):
    monkeypatch.setenv("TINY_LINE_MARKS", str(tmp_path))
    sandbox = Sandbox(_setup(tmp_path, memory_mb=2000))
    item = encode(ImageRow(scene_id="a", kind="capture", uri="/x", name="bulky"))
    killed = []

    def kill_at_the_end() -> None:
        """Forty megabytes do not fit into a socket: the child hangs in its sending while nobody reads."""
        if not killed and (tmp_path / "a.pack").exists():
            (child,) = _children()
            killed.append(child.pid)
            child.send_signal(sent)

    real = Channel.receive

    def slow_receive(self: Channel) -> bytes:
        message = real(self)
        if message[:1] == b"d":
            kill_at_the_end()
        return message

    monkeypatch.setattr(Channel, "receive", slow_receive)
    report, value = sandbox.run(_chain(range(4)), item)
    sandbox.close()
    assert killed
    assert [stage.outcome for stage in report.stages] == [None] * 4
    assert len(decode(value).files[0][1]) == 40_000_000
    assert report.stages[-1].attempts == (1 if sent == signal.SIGKILL else 2)


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
    (tmp_path / "records" / "shard-00000" / "odd.pack").mkdir(parents=True)
    with pytest.raises(BuildError, match=r"cannot read .*odd\.pack@0"):
        sandbox.run(replace(_chain([1]), input_record="shard-00000/odd.pack@0"), b"")
    sandbox.close()
