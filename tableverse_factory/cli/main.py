"""The command `tableverse`: the table of its commands, and its text without one."""

import os
from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.core import TyperGroup

from tableverse_factory.cli.bench import bench
from tableverse_factory.cli.benchmark import benchmark
from tableverse_factory.cli.build import build
from tableverse_factory.cli.config import config
from tableverse_factory.cli.cousins import cousins
from tableverse_factory.cli.doctor import doctor
from tableverse_factory.cli.estimate import estimate
from tableverse_factory.cli.evaluate import evaluate
from tableverse_factory.cli.exit_codes import run_command
from tableverse_factory.cli.export import export
from tableverse_factory.cli.extract import extract
from tableverse_factory.cli.failures import failures
from tableverse_factory.cli.init import init
from tableverse_factory.cli.manifest import manifest
from tableverse_factory.cli.models import models
from tableverse_factory.cli.publish import publish
from tableverse_factory.cli.query import query
from tableverse_factory.cli.report import report
from tableverse_factory.cli.stats import stats
from tableverse_factory.cli.status import status
from tableverse_factory.cli.submit import submit
from tableverse_factory.cli.synth import synth
from tableverse_factory.cli.textures import textures
from tableverse_factory.cli.train import train
from tableverse_factory.cli.trajectories import trajectories
from tableverse_factory.cli.verify import verify
from tableverse_factory.cli.view import view
from tableverse_factory.core.version import __version__

FIRST_STEPS = f"""\
TableVerse Factory {__version__}: table-top pictures become certified MuJoCo scenes.

First steps:
  tableverse doctor                                   check this machine
  tableverse synth captures                           synthetic captures to try it with
  tableverse manifest captures --out images.parquet   check the captures
  tableverse build images.parquet out                 build the dataset
  tableverse report out                               a gallery for the browser
  tableverse view out                                 an interactive 3D view of a scene
  tableverse status out                               progress of the build

With pictures of your own: tableverse init FOLDER says where they belong.
All commands: tableverse --help. One of them, with an example: tableverse build --help
"""

# Commands import heavy modules inside their function, so that `tableverse --help` is fast.
PANELS: dict[str, dict[str, Callable[..., Any] | typer.Typer]] = {
    "Make: from pictures to a dataset": {
        "init": init,
        "synth": synth,
        "manifest": manifest,
        "build": build,
        "trajectories": trajectories,
        "cousins": cousins,
        "textures": textures,
        "models": models,
        "train": train,
    },
    "Run: follow it, plan it, mend it": {
        "status": status,
        "failures": failures,
        "estimate": estimate,
        "submit": submit,
        "config": config,
        "doctor": doctor,
    },
    "Look: what came out": {"report": report, "view": view, "stats": stats, "query": query},
    "Use: take it elsewhere": {"extract": extract, "export": export, "publish": publish},
    "Measure: is it true, is it good": {"verify": verify, "evaluate": evaluate, "benchmark": benchmark, "bench": bench},
}
COMMANDS = {name: command for panel in PANELS.values() for name, command in panel.items()}


class _OrderedGroup(TyperGroup):
    """Group of commands that lists them in the order of their table."""

    def list_commands(self, ctx: Any) -> list[str]:
        return sorted(super().list_commands(ctx), key=[*COMMANDS].index)


app = typer.Typer(
    name="tableverse",
    cls=_OrderedGroup,
    help="Table-top pictures become simulation-ready, certified MuJoCo scenes.",
    invoke_without_command=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _panel, _commands in PANELS.items():
    for _name, _command in _commands.items():
        if isinstance(_command, typer.Typer):
            app.add_typer(_command, name=_name, rich_help_panel=_panel)
        else:
            app.command(_name, rich_help_panel=_panel)(_command)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"tableverse {__version__}")
        raise typer.Exit


@app.callback()
def _without_a_command(
    context: typer.Context,
    version: Annotated[  # noqa: ARG001 its callback answers
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    if context.invoked_subcommand is None:
        print(FIRST_STEPS, end="")


def main() -> None:
    """Run the command line; docs/command-line.md lists its exit codes."""
    # Before numpy loads it. Beside other work, its threads for matrices of 3 x 3 made an interpolation of 5 ms last 5 s
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    raise SystemExit(run_command(lambda: app(standalone_mode=False)))
