"""Completion, as the shells ask for it: real bash with the script that `--show-completion` prints, zsh's and fish's."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tableverse_factory.core.config import list_keys
from tests.helpers.paths import ROOT
from tests.helpers.small_dataset import write_small_dataset

pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def here(tmp_path_factory) -> Path:
    """A folder with a dataset, and `tableverse` on the path."""
    folder = tmp_path_factory.mktemp("shell")
    write_small_dataset(folder / "out")
    command = folder / "bin" / "tableverse"
    command.parent.mkdir()
    command.write_text(f"#!{sys.executable}\nfrom tableverse_factory.cli.main import main\nmain()\n")
    command.chmod(0o755)
    return folder


def run(here: Path, *command: str, **variables: str) -> str:
    path = f"{here / 'bin'}:{os.environ['PATH']}"
    environment = {**os.environ, "PATH": path, "PYTHONPATH": str(ROOT), **variables}
    ended = subprocess.run(command, cwd=here, env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stderr
    assert ended.stderr == ""
    return ended.stdout


def bash(here: Path, line: str) -> list[str]:
    """What bash would offer after this line and a tab."""
    words = line.split(" ")
    variables = {"COMP_WORDS": "\n".join(words), "COMP_CWORD": str(len(words) - 1)}
    return run(here, "tableverse", _TABLEVERSE_COMPLETE="complete_bash", **variables).split()


@pytest.mark.parametrize(
    ("line", "offered", "not_offered"),
    [
        ("tableverse st", {"stats", "status"}, {"build"}),
        ("tableverse build --", {"--workers", "--set", "--from", "--help"}, {"--films"}),
        ("tableverse build m.parquet out --executor ", {"local", "ray"}, set()),
        ("tableverse build m.parquet out --set rectify.cl", {"rectify.clearance_m="}, {"rectify.method="}),
        ("tableverse query out --columns scene_id,stat", {"scene_id,status"}, {"scene_id,usable"}),
        ("tableverse extract out there --scene c", {"c-3", "c-4"}, {"a-1", "b-2"}),
        ("tableverse extract nowhere there --scene c", set(), {"c-3"}),
        *(
            pytest.param(*more, marks=pytest.mark.slow)
            for more in (
                ("tableverse build m.parquet out --from se", {"settle"}, {"export"}),
                ("tableverse trajectories out --set ", {"trajectories.robot="}, {"run.seed="}),
                ("tableverse query out --table o", {"objects"}, {"scenes"}),
                ("tableverse query out --table objects --columns mass", {"mass_kg"}, {"status"}),
                ("tableverse extract out there --texture marb", {"marble-"}, set()),
                ("tableverse failures out --stage cur", {"curate"}, set()),
                ("tableverse export ler", {"lerobot"}, set()),
            )
        ),
    ],
)
def test_bash_is_offered_what_fits(here, line, offered, not_offered):
    words = set(bash(here, line))
    assert offered <= words
    assert not not_offered & words


def test_every_key_is_offered(here):
    assert bash(here, "tableverse build m.parquet out --set ") == [f"{key}=" for key in list_keys()]


def test_the_printed_script_works_in_bash(here):
    """The script is loaded and its function called as bash does when the tab key is pressed."""
    script = run(here, "tableverse", "--show-completion", "bash", _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1")
    assert "complete -o default" in script, "where nothing is offered, bash completes files"
    words = "COMP_WORDS=(tableverse extract out there --scene c); COMP_CWORD=5"
    press = f'{words}; _tableverse_completion tableverse; echo "${{COMPREPLY[@]}}"'
    assert run(here, shutil.which("bash") or "bash", "--norc", "-c", f"{script}\n{press}") == "c-3 c-4\n"


@pytest.mark.slow  # those of bash are tested above
def test_zsh_and_fish_are_answered_in_their_own_terms(here):
    asked = {
        "_TYPER_COMPLETE_ARGS": "tableverse extract out there --scene c",
        "_TYPER_COMPLETE_FISH_ACTION": "get-args",
    }
    assert '"c-3"' in run(here, "tableverse", _TABLEVERSE_COMPLETE="complete_zsh", **asked)
    assert "c-3" in run(here, "tableverse", _TABLEVERSE_COMPLETE="complete_fish", **asked)


def test_installing_writes_the_script_for_bash(here, tmp_path):
    said = run(
        here,
        "tableverse",
        "--install-completion",
        "bash",
        HOME=str(tmp_path),
        _TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION="1",
    )
    assert "bash completion installed" in said
    (script,) = tmp_path.rglob("tableverse.sh")
    assert "_tableverse_completion" in script.read_text()
    assert script.name in (tmp_path / ".bashrc").read_text()
