"""A log is never scrolled to death: however many scenes there are, few lines; nothing that moves a cursor."""

import io
import json
import os
import re
import subprocess
import sys
import time
from itertools import pairwise

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tableverse_factory.cli import progress_bar as counter_module
from tableverse_factory.cli.progress_bar import count_progress, track_progress
from tests.helpers.fake_build_display import STAGES
from tests.helpers.paths import ROOT
from workers.progress import console as progress_module
from workers.progress.console import OrderedConsole, ProgressDisplay, choose_log_interval_s
from workers.progress.tally import Tally

SCENES = 100_000
TABLEVERSE = [sys.executable, "-c", "from tableverse_factory.cli.main import main; main()"]


class Clock:
    """Time that passes as fast as the test wants."""

    def __init__(self) -> None:
        self.now = time.monotonic()

    def monotonic(self) -> float:
        return self.now


@pytest.fixture
def clock(monkeypatch) -> Clock:
    clock = Clock()
    for module in (counter_module, progress_module):
        monkeypatch.setattr(module, "time", clock)
    return clock


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("hours", "most"),
    [(10.0, 260), *(pytest.param(*its, marks=pytest.mark.slow) for its in ((0.1, 80), (240.0, 3000)))],
)
def test_a_build_of_100_000_scenes_says_few_lines(clock, hours, most):
    """Every scene fails and is noted, as where a model is misconfigured."""
    log = io.StringIO()
    tally = Tally(STAGES, total=SCENES, before=0, shards=1563)
    with ProgressDisplay(OrderedConsole(file=log, width=120)) as progress:
        for scene in range(SCENES):
            clock.now += hours * 3600 / SCENES
            tally.ended["settle", "failed"] += 1
            progress.note(f"scene_{scene}: settle failed")
            progress.show(tally)
    lines = log.getvalue().splitlines()
    assert 20 < len(lines) < most
    assert "100000/100000 scenes" in lines[-1]
    assert "\x1b" not in log.getvalue()


def test_lines_become_rarer_and_never_stop():
    waits = [choose_log_interval_s(elapsed) for elapsed in (0.0, 60.0, 600.0, 3600.0, 1e6)]
    assert waits == sorted(waits)
    assert waits[0] == 5.0
    assert waits[-1] == 300.0


@pytest.mark.parametrize("colour", [{}, {"FORCE_COLOR": "1"}])
def test_a_counter_says_lines_on_stderr_where_there_is_no_terminal(clock, capsys, monkeypatch, colour):
    for name, value in colour.items():
        monkeypatch.setenv(name, value)
    with count_progress("scenes", SCENES) as done:
        for _ in range(SCENES):
            clock.now += 0.1
            done()
    said = capsys.readouterr()
    assert said.out == ""
    lines = said.err.splitlines()
    counts = [int(re.fullmatch(r"scenes: (\d+) of 100000", line)[1]) for line in lines]
    assert 20 < len(lines) < 120
    assert all(a < b for a, b in pairwise(counts))


def test_items_are_counted_with_their_total_up_to_the_last(clock, capsys):
    def compute():
        for number in range(7):
            clock.now += 4.0
            yield number

    assert [*track_progress("meshes", compute(), 7)] == [*range(7)]
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "meshes: 2 of 7"
    assert lines[-1] == "meshes: 7 of 7"
    assert len({*lines}) == len(lines)


def test_what_is_quick_says_nothing(capsys):
    with count_progress("scenes", 3) as done:
        for _ in range(3):
            done()
    assert capsys.readouterr() == ("", "")


@pytest.mark.heavy
def test_a_real_build_in_a_pipe_keeps_its_streams_apart(tmp_path):
    """What is said goes to stderr and the outcome to stdout, plain, and the data of other commands alone on stdout."""
    rows = [{"scene_id": f"s{i}", "kind": "capture", "uri": "/x", "rejected": "unreadable_color"} for i in range(2000)]
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "m.parquet")
    environment = {**os.environ, "FORCE_COLOR": "1", "PYTHONPATH": str(ROOT)}

    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run([*TABLEVERSE, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True)

    built = run("build", "m.parquet", "out", "--executor", "local")
    assert built.returncode == 0
    counts, why = built.stdout.splitlines()
    assert counts == "0 done, 2000 dropped, 0 failed of 2000 scenes, in out"
    query = """tableverse query out --where "status = 'dropped'" --columns scene_id,reason,detail"""
    assert why == f"why 2000 were dropped: {query}"
    assert len(built.stderr.splitlines()) < 20
    assert not re.search(r"\x1b\[[0-9;?]*[A-HJKfhl]", built.stderr), "the cursor moves in a log"
    status = run("status", "out", "--json")
    assert json.loads(status.stdout)["dropped"] == 2000
    assert status.stderr == ""
