"""Exit codes as docs/command-line.md has them, of real processes; and what is printed where little can be shown."""

import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.helpers.captures_on_disk import write_picture
from tests.helpers.paths import ROOT
from tests.helpers.small_dataset import write_small_dataset

pytestmark = pytest.mark.heavy

TABLEVERSE = [sys.executable, "-c", "from tableverse_factory.cli.main import main; main()"]
PLAIN = {key: value for key, value in os.environ.items() if key not in ("NO_COLOR", "FORCE_COLOR", "TABLEVERSE_DEBUG")}


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """`out`, written by hand, has scenes; `built`, by a real build, has none that could be used."""
    home = tmp_path_factory.mktemp("home")
    write_small_dataset(home / "out")
    write_picture(home / "photos" / "a.png", 1)
    rows = [{"scene_id": "s", "kind": "capture", "uri": "/x", "rejected": "unreadable_color"}]
    pq.write_table(pa.Table.from_pylist(rows), home / "images.parquet")
    assert run(home, "build", "images.parquet", "built", "--executor", "local").returncode == 0
    return home


def run(home: Path, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
    environment = {**PLAIN, "PYTHONPATH": str(ROOT), **variables}
    return subprocess.run([*TABLEVERSE, *arguments], cwd=home, env=environment, capture_output=True, text=True)


def test_a_build_of_an_empty_manifest_says_that_its_dataset_is_empty(home: Path, tmp_path: Path) -> None:
    pq.write_table(pq.read_table(home / "images.parquet").slice(0, 0), tmp_path / "none.parquet")
    ended = run(tmp_path, "build", "none.parquet", "new", "--executor", "local")
    assert ended.returncode == 0
    assert "the manifest has no row: this dataset is empty" in ended.stdout


def pipeline(home: Path, line: str) -> tuple[list[int], str, str]:
    """Exit codes of a line of bash in which `T` stands for the command, its stdout and stderr."""
    ours = f"{sys.executable} -c '{TABLEVERSE[2]}'"
    ended = subprocess.run(
        ["bash", "-c", f'{line.replace("T ", ours + " ")}; echo "${{PIPESTATUS[@]}}" > codes'],
        cwd=home,
        env={**PLAIN, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    return [int(code) for code in (home / "codes").read_text().split()], ended.stdout, ended.stderr


def test_the_codes_are_documented():
    page = (ROOT / "docs" / "command-line.md").read_text()
    documented = set(re.findall(r"^\| ([\d, ]+) \|", page, flags=re.MULTILINE))
    assert documented == {"0", "1", "2", "3", "4", "130, 143", "141"}


def test_well_wrong_and_not_understood(home):
    assert run(home, "query", "out").returncode == 0
    wrong = run(home, "query", "nowhere")
    assert (wrong.returncode, wrong.stdout) == (1, "")
    misspelt = run(home, "query", "out", "--lmit", "3")
    assert (misspelt.returncode, misspelt.stdout) == (2, "")


@pytest.mark.parametrize(
    "command",
    [
        "query out --json --table objects",
        *(pytest.param(command, marks=pytest.mark.slow) for command in ("config", "--help", "query out --format csv")),
    ],
)
def test_a_reader_who_has_seen_enough_is_no_error(home, command):
    codes, out, err = pipeline(home, f"T {command} | head -c 5")
    assert codes[0] in (0, 141), "0 where all was written before the pipe was closed"
    assert codes[1] == 0
    assert len(out) == 5
    assert err == ""


def test_nobody_reads_is_141_and_quiet(home):
    """The reader is gone before the first word."""
    codes, _, err = pipeline(home, "T config | true")
    assert codes == [141, 0]
    assert err == ""


def test_a_full_disk_says_so_and_leaves_no_half_file(home):
    codes, _, err = pipeline(home, "T query out > /dev/full")
    assert codes == [1]
    assert re.fullmatch(r"error: [^\n]*No space left on device[^\n]*make room[^\n]*\n", err)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_what_may_not_be_read_is_one_line(home, tmp_path):
    shutil.copytree(home / "out", tmp_path / "out")
    (tmp_path / "out" / "run.json").chmod(0)
    ended = run(tmp_path, "status", "out")
    assert ended.returncode == 1
    assert "Permission denied" in ended.stderr
    assert len(ended.stderr.splitlines()) == 1


@pytest.mark.parametrize(("sent", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, -signal.SIGTERM)])
def test_a_command_that_is_stopped_says_nothing(home, sent, code):
    """`status --watch` waits for a build that goes on; a shell shows a death by SIGTERM as 143."""
    shard = next((home / "built" / "scenes").iterdir())
    away = shard.rename(home / "away.parquet")
    try:
        process = subprocess.Popen(
            [*TABLEVERSE, "status", "built", "--watch", "--every", "0.5"],
            cwd=home,
            env={**PLAIN, "PYTHONPATH": str(ROOT)},
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
        )
        assert process.stdout is not None
        process.stdout.readline()  # it watches
        time.sleep(0.2)
        process.send_signal(sent)
        _, err = process.communicate(timeout=30)
    finally:
        away.rename(shard)
    assert process.returncode == code
    assert err == ""


@pytest.mark.parametrize("encoding", ["ascii", pytest.param("latin-1", marks=pytest.mark.slow)])
def test_a_terminal_that_lacks_letters_shows_their_codes(home, encoding):
    for command in (("query", "out", "--table", "objects"), ("config",), ("--help",)):
        ended = run(home, *command, PYTHONIOENCODING=encoding)
        assert ended.returncode == 0, ended.stderr
        ended.stdout.encode(encoding)


@pytest.mark.parametrize(
    ("variables", "coloured"),
    [
        ({}, False),
        ({"FORCE_COLOR": "1", "TERM": "xterm-256color"}, True),
        pytest.param({"FORCE_COLOR": "1", "NO_COLOR": "1", "TERM": "xterm-256color"}, False, marks=pytest.mark.slow),
        pytest.param({"FORCE_COLOR": "1", "TERM": "dumb"}, False, marks=pytest.mark.slow),
    ],
)
def test_colours_only_where_they_are_wanted(home, variables, coloured):
    said = run(home, "--help", **variables).stdout
    assert bool(re.search(r"\x1b\[[0-9;]*3[0-9]m", said)) == coloured
    data = run(home, "query", "out", "--json", **variables).stdout
    assert "\x1b" not in data
    json.loads(data)


@pytest.mark.parametrize(
    "command",
    ["query out", "status built", "failures built", "config", "stats out", "manifest photos --out m.parquet"],
)
def test_json_stands_alone_on_stdout(home, tableverse, monkeypatch, command):
    monkeypatch.chdir(home)
    answer = tableverse(*command.split(" "), "--json")
    assert answer.code == 0, answer.err
    json.loads(answer.out)
