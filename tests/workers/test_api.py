"""`workers.build` from Python: the code path of the command, without its signals, exit codes and terminal."""

import subprocess
import sys
from pathlib import Path

import pytest

import workers
from tableverse_factory.core.errors import BuildError, ConfigError, InputError
from tableverse_factory.run_record import read_run
from tests.helpers.builds import Silent, digests, write_manifest
from tests.helpers.builds import build as build_with_tiny_line
from workers import build

pytestmark = pytest.mark.heavy


@pytest.fixture
def tiny(monkeypatch, tmp_path):
    """A manifest for the tiny pipeline, which takes the place of the usual one."""
    monkeypatch.setattr("workers.api.PIPELINE", "tests.helpers.tiny_pipeline:PIPELINES")
    monkeypatch.setenv("TABLEVERSE_CACHE", str(tmp_path / "cache"))
    return write_manifest(tmp_path / "m.parquet", ["fine", "empty", "sad", "fine"])


QUICK = {"run.shard_size": 4, "run.deadline_s": 8.0, "run.memory_mb": 400}


def test_importing_workers_is_cheap():
    code = "import sys, workers; print([m for m in ('ray', 'numpy', 'workers.api') if m in sys.modules])"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout == "[]\n"
    with pytest.raises(AttributeError, match="nosuch"):
        _ = workers.nosuch


def test_a_build_returns_what_the_dataset_holds_with_the_bytes_of_the_command(tiny, tmp_path):
    summary = build(tiny, tmp_path / "out", overrides=QUICK, display=None)
    state = summary.read_state()
    assert (state.total, state.done, state.dropped, state.failed) == (4, 2, 1, 1)
    assert state.count_losses() == {("dropped", "look", "nothing_there"): 1, ("failed", "cut", "GeometryError"): 1}
    assert "4 of 4 scenes" in str(summary)
    build_with_tiny_line(tiny, tmp_path / "other")
    assert digests(tmp_path / "out") == digests(tmp_path / "other")


def test_limits_and_resumption(tiny, tmp_path):
    assert build(tiny, tmp_path / "out", overrides=QUICK, limit=1, display=None).read_state().remaining == 3
    assert build(str(tiny), str(tmp_path / "out"), overrides=QUICK, display=None).read_state().remaining == 0


@pytest.mark.parametrize(
    "value",
    [
        "a: b #c",
        *(pytest.param(value, marks=pytest.mark.slow) for value in ("yes", "1.5", "é😀", '"/a\\b')),
        Path("/a b"),
    ],
)
def test_a_text_or_path_among_the_overrides_is_no_yaml(tiny, tmp_path, value):
    build(tiny, tmp_path / "out", overrides={**QUICK, "curate.replay_dir": value}, display=None)
    assert read_run(tmp_path / "out" / "run.json")["config"]["curate"]["replay_dir"] == str(value)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"from_stage": "settel"}, ConfigError, "did you mean settle"),
        ({"stages": "trajectories"}, ConfigError, r"\+trajectories"),
        ({"overrides": {"run.sed": 1}}, ConfigError, r"^--set or override: .*run\.seed"),
        ({"overrides": {"run.shard_size": "few"}}, ConfigError, r"^--set or override: run\.shard_size: 'few'"),
        ({"executor": "Local"}, ConfigError, "'Local': give local or ray"),
        ({"limit": -1}, ConfigError, "limit -1: give 1 or more"),
        ({"max_calls": -3}, ConfigError, "max_calls -3: give 0 or more"),
        ({"max_usd": float("nan")}, ConfigError, "amount of money"),
        ({"executor": "ray", "address": "host"}, BuildError, "HOST:PORT"),
        ({"executor": "local", "workers": 4}, BuildError, "one worker"),
    ],
)
def test_wrong_arguments_raise_an_error_that_names_them(tiny, tmp_path, arguments, error, message):
    with pytest.raises(error, match=message):
        build(tiny, tmp_path / "out", display=None, **arguments)


def test_a_missing_manifest_raises(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        build(tmp_path / "none.parquet", tmp_path / "out", display=None)


class Interrupt(Silent):
    """Raises as Ctrl-C would, once a scene is recorded."""

    def show(self, tally):
        if tally.ended:
            raise KeyboardInterrupt


def test_an_interrupt_raises_and_keeps_finished_scenes(tiny, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        build(tiny, tmp_path / "out", overrides=QUICK, display=Interrupt())
    summary = build(tiny, tmp_path / "out", overrides=QUICK, display=None)
    assert summary.tally.before > 0
    assert summary.read_state().remaining == 0
