"""The roof: every command has help with an example, answers fast, and an error is one line, never a traceback."""

import re
import subprocess
import sys

import pytest
import typer

from tableverse_factory.cli.main import COMMANDS, app
from tableverse_factory.core.version import __version__
from tests.helpers.paths import ROOT

LAUNCH = [sys.executable, "-m", "tableverse_factory"]


def test_the_version_is_printed(tableverse):
    assert tableverse("--version") == type(tableverse("--version"))(0, f"tableverse {__version__}\n", "")


def test_help_lists_every_command(tableverse):
    answer = tableverse("--help")
    assert answer.code == 0
    for name in COMMANDS:
        assert re.search(rf"│ {name} ", answer.out), name


def words():
    """Every command as it is typed, those of groups too."""
    for name, command in COMMANDS.items():
        if isinstance(command, typer.Typer):
            yield from ((name, str(below.name)) for below in command.registered_commands)
        else:
            yield (name,)


@pytest.mark.parametrize("command", [*words()], ids=" ".join)
def test_every_command_has_help_with_an_example(tableverse, command):
    answer = tableverse(*command, "--help")
    assert answer.code == 0
    assert f"tableverse {' '.join(command)}" in answer.out.partition("Example")[2]


@pytest.mark.heavy
def test_nothing_heavy_is_imported_before_a_command_runs():
    """`--help` must answer at once; who imports pyarrow for it waits a second."""
    code = (
        "import sys, tableverse_factory.cli.main; heavy = {'numpy', 'pyarrow', 'mujoco', 'ray', 'open3d', 'trimesh',"
        "'scipy', 'pydantic', 'fsspec', 'yaml'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    "arguments",
    [
        ("extract", "nowhere", "a"),
        ("query", "nowhere"),
        ("manifest", "nowhere", "--out", "m.parquet"),
        ("config", "--set", "rectify.clearence_m=1"),
        ("config", "--config", "nowhere.yaml"),
        ("manifest", ".", "--out", "a_file/m.parquet"),
    ],
)
def test_an_expected_error_is_a_line_with_a_link_on_stderr(tableverse, tmp_path, monkeypatch, arguments):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a_file").write_text("")
    answer = tableverse(*arguments)
    assert answer.code == 1
    assert re.fullmatch(r"error: [^\n]+\nhelp: docs/troubleshooting\.md#[\w-]+\n", answer.err)
    assert answer.out == ""


def test_a_wrong_option_is_exit_code_2(tableverse):
    assert tableverse("query", "--nosuch").code == 2
    assert tableverse("nosuch").code == 2


@pytest.mark.heavy
def test_the_traceback_is_there_for_who_asks(tmp_path):
    ended = subprocess.run(
        [*LAUNCH, "query", str(tmp_path / "nowhere")], env={"TABLEVERSE_DEBUG": "1"}, capture_output=True, text=True
    )
    assert ended.returncode == 1
    assert "Traceback" in ended.stderr


@pytest.mark.heavy
def test_ctrl_c_is_130_without_a_traceback():
    code = (
        "from tableverse_factory.cli.main import app, main\n"
        "def wait():\n    raise KeyboardInterrupt\n"
        "app.command('wait')(wait)\nimport sys; sys.argv = ['tableverse', 'wait']; main()"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert ended.returncode == 130
    assert ended.stderr == ""


@pytest.mark.parametrize(("given", "used"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")])
def test_linear_algebra_has_one_thread_unless_the_user_says_otherwise(given, used):
    code = (
        "import tableverse_factory.cli.main as m, os\ntry: m.main()\nfinally: print(os.environ['OPENBLAS_NUM_THREADS'])"
    )
    ended = subprocess.run([sys.executable, "-c", code], env=given, capture_output=True, text=True)
    assert ended.stdout.splitlines()[-1] == used


@pytest.mark.heavy
def test_a_closed_pipe_is_no_traceback(tmp_path):
    """`tableverse config | head -1`."""
    shell = f"{' '.join(LAUNCH)} config | head -1"
    ended = subprocess.run(["bash", "-c", shell], capture_output=True, text=True)
    assert ended.returncode == 0
    assert ended.stdout.startswith("# Every key")
    assert "Traceback" not in ended.stderr


@pytest.mark.heavy
def test_colour_is_left_out_where_it_is_not_wanted():
    coloured = {"FORCE_COLOR": "1", "TERM": "xterm-256color"}
    with_colour = subprocess.run([*LAUNCH, "--help"], env=coloured, capture_output=True)
    without = subprocess.run([*LAUNCH, "--help"], env={**coloured, "NO_COLOR": "1"}, capture_output=True)
    yellow = rb"\x1b\[[0-9;]*33m"
    assert re.search(yellow, with_colour.stdout)
    assert not re.search(yellow, without.stdout)


def test_commands_are_named_once():
    assert len(app.registered_commands) + len(app.registered_groups) == len(COMMANDS)


def test_every_command_is_documented():
    page = ROOT / "docs" / "command-line.md"
    documented = re.findall(r"^\| `([a-z]+)", page.read_text(), flags=re.MULTILINE)
    assert documented[: len(COMMANDS)] == list(COMMANDS)
