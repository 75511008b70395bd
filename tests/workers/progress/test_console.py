"""The display on real pseudo-terminals, looked at through a terminal emulator, and in logs."""

import re
import signal
import subprocess
import sys

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.helpers.paths import HELPERS
from tests.helpers.terminal import PLAIN, ROOT, Seen, watch

pytestmark = pytest.mark.heavy

PRETEND = [sys.executable, str(HELPERS / "fake_build_display.py")]
TABLEVERSE = [sys.executable, "-c", "from tableverse_factory.cli.main import main; main()"]


@pytest.fixture(scope="module")
def seen() -> Seen:
    """A build that goes well, in a terminal with room for all of it."""
    return watch([*PRETEND, "0", "well"], size=(100, 60))


def test_the_table_is_drawn_over_itself_and_stays_at_the_end(seen):
    text = "\n".join(seen.screen)
    assert seen.code == 0
    assert text.count("stage  ") == 1
    assert re.search(r"^settle +· +· +200 +20 ", text, re.MULTILINE)
    assert re.search(r"^export +· +· +200 ", text, re.MULTILINE)
    assert "220/400 scenes (55.0%)" in text
    assert "workers: perception 1/2, physics 2/2" in text
    assert seen.screen[-1] == "out"
    assert not seen.cursor_hidden
    assert not any(line.startswith("stage") for line in seen.scrolled), "an old table scrolled away"
    assert len(seen.scrolled) < 100


def test_what_is_printed_while_the_table_is_drawn_leaves_no_second_table():
    """rich's own refreshing thread left two in seven of eight runs."""
    seen = watch([*PRETEND, "0", "slow"], size=(100, 60))
    assert sum(line.startswith("stage  ") for line in [*seen.scrolled, *seen.screen]) == 1


def test_a_failure_of_every_scene_does_not_bury_the_table(seen):
    text = "\n".join(seen.screen)
    assert text.count("TypeError") <= 20
    assert "tableverse failures" in text
    assert b"\x1b[31mTypeError" not in seen.raw


@pytest.mark.slow  # a build for a line of the display
def test_a_cold_start_is_seen_to_be_one():
    seen = watch([*PRETEND, "2.5", "well"])
    assert any("preparing, 2 s" in "\n".join(look) and "starting Ray" in "\n".join(look) for look in seen.looks)
    assert "preparing" not in "\n".join(seen.screen)


@pytest.mark.parametrize(
    "size", [(20, 4), *(pytest.param(size, marks=pytest.mark.slow) for size in ((40, 30), (100, 8)))]
)
def test_a_small_terminal_shows_what_matters(size):
    seen = watch([*PRETEND, "0", "well"], size=size)
    assert seen.code == 0
    assert any("/400 scenes" in line for look in seen.looks for line in look)
    assert not seen.cursor_hidden


def test_another_size_half_way_is_survived():
    seen = watch([*PRETEND, "0", "well"], size=(120, 60), at=0.6, resize=(60, 20))
    assert seen.code == 0
    assert "220/400 scenes" in "\n".join(seen.screen)


def test_no_colour_where_it_is_not_wanted(seen):
    colours = rb"\x1b\[[0-9;]*3[0-9]m"
    assert re.search(colours, seen.raw)
    assert not re.search(colours, watch([*PRETEND, "0", "well"], environment={"NO_COLOR": "1"}).raw)


def test_an_error_leaves_the_terminal_usable():
    seen = watch([*PRETEND, "0", "error"], size=(100, 60))
    assert seen.code == 1
    assert "ValueError: the disk is full" in seen.screen[-1]
    assert not seen.cursor_hidden


@pytest.mark.parametrize(
    "environment",
    [{"FORCE_COLOR": "1"}, *(pytest.param(its, marks=pytest.mark.slow) for its in ({}, {"TERM": "dumb"}))],
)
def test_a_log_gets_lines_and_few_of_them(environment):
    ended = subprocess.run(
        [*PRETEND, "0", "well"], capture_output=True, text=True, cwd=ROOT, env={**PLAIN, **environment}
    )
    assert ended.stdout == "out\n"
    lines = [line for line in ended.stderr.splitlines() if "scenes" in line]
    assert len(lines) == 1
    assert "220/400 scenes" in lines[0]
    assert "200 done, 20 dropped, 0 failed; 0/4 shards" in lines[0]
    assert not re.search(r"\x1b\[[0-9;?]*[A-HJKfhl]", ended.stderr), "the cursor moves in a log"


def test_a_dumb_terminal_gets_lines_too():
    seen = watch([*PRETEND, "0", "well"], size=(100, 60), environment={"TERM": "dumb"})
    assert b"\x1b[1A" not in seen.raw
    assert "220/400 scenes" in "\n".join(seen.screen)


@pytest.mark.slow  # test_follow.py follows a build to its end
def test_watching_ends_with_the_build_and_ctrl_c_is_clean(tmp_path):
    rows = [{"scene_id": f"s{i}", "kind": "capture", "uri": "/x", "rejected": "unreadable_color"} for i in range(70)]
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "m.parquet")
    out = str(tmp_path / "out")
    subprocess.run([*TABLEVERSE, "build", str(tmp_path / "m.parquet"), out, "--executor", "local"], check=True)

    seen = watch([*TABLEVERSE, "status", out, "--watch"])
    assert seen.code == 0
    assert "70/70 scenes, complete" in seen.screen
    assert re.search(r"^manifest +· +70 ", "\n".join(seen.screen), re.MULTILINE)

    for path in (tmp_path / "out" / "scenes").iterdir():
        path.unlink()
    seen = watch([*TABLEVERSE, "status", out, "--watch", "--every", "0.5"], at=2.5, then=signal.SIGINT)
    assert seen.code == 130
    assert "no build is writing" in seen.screen[0]
    assert "Traceback" not in "\n".join(seen.screen)
    assert not seen.cursor_hidden

    gone = subprocess.run([*TABLEVERSE, "status", str(tmp_path), "--watch"], capture_output=True, text=True)
    assert gone.returncode == 1
    assert re.fullmatch(r"error: [^\n]+holds no build[^\n]+\nhelp: docs/troubleshooting\.md#[^\n]+\n", gone.stderr)
    assert subprocess.run([*TABLEVERSE, "status", out, "--watch", "--json"], capture_output=True).returncode == 2
