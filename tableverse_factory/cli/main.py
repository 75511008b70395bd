"""The command `tableverse`: the table of its commands, and what becomes of errors."""

import os
import sys
from collections.abc import Callable
from typing import Annotated, Any

import typer

from tableverse_factory import __version__
from tableverse_factory.cli.bench import bench
from tableverse_factory.cli.build import build
from tableverse_factory.cli.config import config
from tableverse_factory.cli.doctor import doctor
from tableverse_factory.cli.estimate import estimate
from tableverse_factory.cli.evaluate import evaluate
from tableverse_factory.cli.export import export
from tableverse_factory.cli.extract import extract
from tableverse_factory.cli.failures import failures
from tableverse_factory.cli.manifest import manifest
from tableverse_factory.cli.query import query
from tableverse_factory.cli.report import report
from tableverse_factory.cli.stats import stats
from tableverse_factory.cli.status import status
from tableverse_factory.cli.submit import submit
from tableverse_factory.cli.synth import synth
from tableverse_factory.cli.textures import textures
from tableverse_factory.cli.trajectories import trajectories
from tableverse_factory.cli.verify import verify
from tableverse_factory.errors import TableverseError

# Modules of commands import what is heavy inside their function: `tableverse --help` answers at once.
COMMANDS: dict[str, Callable[..., Any] | typer.Typer] = {
    "synth": synth,
    "manifest": manifest,
    "build": build,
    "submit": submit,
    "trajectories": trajectories,
    "status": status,
    "estimate": estimate,
    "failures": failures,
    "query": query,
    "extract": extract,
    "export": export,
    "verify": verify,
    "report": report,
    "stats": stats,
    "textures": textures,
    "evaluate": evaluate,
    "bench": bench,
    "doctor": doctor,
    "config": config,
}

app = typer.Typer(
    name="tableverse",
    help="Table-top pictures become simulation-ready, certified MuJoCo scenes.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
    context_settings={"help_option_names": ["-h", "--help"]},
)
for _name, _command in COMMANDS.items():
    if isinstance(_command, typer.Typer):
        app.add_typer(_command, name=_name)
    else:
        app.command(_name)(_command)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"tableverse {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Runs the command line: an expected error is one line on stderr and exit code 1, Ctrl-C is 130."""
    try:
        app()
    except TableverseError as error:
        _fail(error, str(error))
    except OSError as error:
        _fail(error, f"{error.filename or type(error).__name__}: {error.strerror or error}")
    except ValueError as error:
        if not type(error).__module__.startswith("pyarrow"):
            raise
        _fail(error, f"a Parquet file is damaged: {' '.join(str(error).split())[:400]}")
    except Exception as error:
        if type(error).__module__.partition(".")[0] not in ("aiohttp", "botocore"):
            raise
        _fail(error, f"the object store broke off an answer ({type(error).__name__}): run the same command again")


def _fail(error: Exception, message: str) -> None:
    if os.environ.get("TABLEVERSE_DEBUG"):
        raise error
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(1)
