"""`tableverse submit`: a build as a job of a Ray cluster; the same command again resumes."""

import os
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any

import typer

from tableverse_factory.cli.build import build
from tableverse_factory.core.errors import BuildError

_FILE_OPTIONS = ("--config", "--pools")  # their files travel with the job, as the manifest does


def submit(
    manifest: Annotated[
        str, typer.Argument(metavar="MANIFEST", help="Image manifest: a file here, or its path or URI on the cluster.")
    ],
    out: Annotated[
        str, typer.Argument(metavar="OUT", help="Dataset: a URI, or a folder that the head of the cluster sees.")
    ],
    options: Annotated[
        list[str] | None, typer.Argument(metavar="-- OPTIONS", help="After `--`: options of `tableverse build`.")
    ] = None,
    address: Annotated[
        str, typer.Option(envvar="RAY_API_SERVER_ADDRESS", metavar="URL", help="The head's port for jobs.")
    ] = "http://127.0.0.1:8265",
    wait: Annotated[bool, typer.Option("--wait", help="Follow the log; exit with the build's own code.")] = False,
    stop: Annotated[bool, typer.Option("--stop", help="Stop the job that builds OUT; what is finished stays.")] = False,
    env: Annotated[
        list[str] | None,
        typer.Option("--env", metavar="NAME", help="A variable to hand over from this shell, may repeat."),
    ] = None,
    pip: Annotated[
        list[str] | None,
        typer.Option("--pip", metavar="REQUIREMENT", help="Requirement to install for this job, may repeat."),
    ] = None,
    working_dir: Annotated[
        Path | None, typer.Option("--working-dir", metavar="FOLDER", help="Folder to run in; it travels with the job.")
    ] = None,
) -> None:
    """Build as a job of a Ray cluster.

    The job goes on when this shell is closed. Files that are named and lie here (manifest, `--config`, `--pools`)
    travel with the job; other paths are looked for on the cluster. Exit code with `--wait`: that of `tableverse
    build`; 143 where the job was stopped.

    Example: `tableverse submit images.parquet s3://bucket/out --address http://head:8265 --wait -- --workers 64`
    """
    from workers.executors.ray_jobs import JobServer

    out = out if "://" in out else str(Path(out).absolute())
    command = build_command(manifest, out, options or [])
    variables = {name: _read_variable(name) for name in env or []}
    if stop:
        _stop(JobServer(address), out)
        return
    _check_files(parse_build(command[2:]), working_dir or Path())
    with _stage_files(command, working_dir) as (command, folder):
        runtime_env = {"working_dir": folder, "env_vars": variables, "pip": pip}
        server = JobServer(address)
        job = server.submit(out, command, {key: value for key, value in runtime_env.items() if value})
    print(f"job {job} on {server.address}: {' '.join(command)}", flush=True)
    if not wait:
        print(f"follow it: ray job logs --follow --address {server.address} {job}")
        return
    raise typer.Exit(_follow(server, job))


def build_command(manifest: str, out: str, options: Sequence[str]) -> list[str]:
    """Make the command of the job, after the command line of `build` has accepted it."""
    arguments = [manifest, out, "--executor", "ray", *options]
    parsed = parse_build(arguments)
    if parsed["executor"] != "ray":
        raise BuildError("a job runs on its cluster: leave --executor out")
    if any(option.partition("=")[0] == "--address" for option in options):
        raise BuildError("a job joins the cluster that it is submitted to: give --address before the --")
    return ["tableverse", "build", *arguments]


def parse_build(arguments: Sequence[str]) -> dict[str, Any]:
    """Parse arguments as `tableverse build` would, without running it."""
    app = typer.Typer()
    app.command("build")(build)
    context = typer.main.get_command(app).make_context("tableverse build", list(arguments))
    return dict(context.params)


def _check_files(parsed: Mapping[str, Any], folder: Path) -> None:
    """Read `--config`, `--set` and `--pools` as the job will, if their files are here."""
    from tableverse_factory.core.config import load_config
    from tableverse_factory.core.pools_file import load_pools

    config, pools = (None if parsed[name] is None else folder / parsed[name] for name in ("config", "pools"))
    if config is not None and not config.is_file():
        return  # it is on the cluster
    settings = load_config(config, parsed["overrides"] or [])
    if pools is None or pools.is_file():
        load_pools(pools, settings)


@contextmanager
def _stage_files(command: Sequence[str], working_dir: Path | None) -> Iterator[tuple[list[str], str | None]]:
    """Yield the command for the cluster and the folder of files that travel with it, if any."""
    if working_dir is not None:
        if not working_dir.is_dir():
            raise BuildError(f"--working-dir {working_dir} is no folder")
        yield list(command), str(working_dir.absolute())
        return
    with TemporaryDirectory(prefix="tableverse-job-") as folder:
        sent = [
            _stage_word(word, Path(folder)) if _names_file(option, word) else word
            for option, word in zip(["", *command], command, strict=False)
        ]
        yield sent, folder if any(Path(folder).iterdir()) else None


def _names_file(before: str, word: str) -> bool:
    """Whether a word, which comes after `before`, names the manifest, or the value of `--config` or `--pools`."""
    return before in ("build", *_FILE_OPTIONS) or word.startswith(tuple(f"{option}=" for option in _FILE_OPTIONS))


def _stage_word(word: str, folder: Path) -> str:
    """Copy the file that a word of the command line names into the folder; returns the word for the cluster."""
    option, equals, value = word.partition("=") if word.startswith("--") else ("", "", word)
    source = Path(value)
    if not value or not source.is_file():
        if option == "" and "://" not in word and source.suffix in {".parquet", ".yaml"} and not source.is_absolute():
            raise BuildError(f"{word} is not here: give a file, or its absolute path or URI on the cluster")
        return word
    target = folder / source.name
    if target.exists():
        raise BuildError(f"two files named {source.name} cannot travel together: rename one")
    shutil.copyfile(source, target)
    return f"{option}{equals}{source.name}"


def _read_variable(name: str) -> str:
    value = os.environ.get(name)
    if value is None:
        raise BuildError(f"--env {name}: there is no such variable here; give the name alone, its value is taken along")
    return value


def _stop(server: Any, out: str) -> None:
    job = server.stop(out)
    if job is None:
        raise BuildError(f"no job on {server.address} is building {out}")
    print(f"stopped {job}; everything finished is kept: submit again to go on")


def _follow(server: Any, job: str) -> int:
    try:
        code: int = server.follow(job, partial(print, end="", flush=True))
    except KeyboardInterrupt:
        print(f"\nnot followed any more; job {job} goes on (the same command with --stop ends it)")
        return 130
    if code == 127:
        print("the head has no command `tableverse`: start Ray there with the environment that has it", file=sys.stderr)
    return code
