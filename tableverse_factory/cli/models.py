"""`tableverse models`: the models that the line can use, and their weights on this machine."""

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tableverse_factory.cli.completions import complete_models
from tableverse_factory.cli.exit_codes import FAILED
from tableverse_factory.cli.options import AsJson
from tableverse_factory.cli.tables import print_json

if TYPE_CHECKING:
    from tableverse_factory.models.local.catalogue import ModelEntry

models = typer.Typer(no_args_is_help=True, help="List real models; fetch and check their weights.")

Names = Annotated[
    list[str] | None,
    typer.Argument(metavar="NAME…", help="Models of `tableverse models list`.", autocompletion=complete_models),
]
ForConfig = Annotated[
    Path | None, typer.Option("--config", metavar="FILE", help="Those that a configuration uses, such as a recipe.")
]
KEYS = {
    "detector": "perceive.detector",
    "segmenter": "perceive.segmenter",
    "depth": "observe.depth",
    "completion": "place.mesh_model",
}


@models.command("list")
def list_models(config: ForConfig = None, as_json: AsJson = False) -> None:
    """List models with what they do, address, commit, size, sha256, licence and what it forbids.

    Example: `tableverse models list --config recipes/pictures-cpu.yaml`
    """
    from tableverse_factory.models.local.catalogue import CATALOGUE

    chosen = _choose((), config) if config else CATALOGUE
    if as_json:
        print_json([{**asdict(model), "weights": model.weights, "size": model.size} for model in chosen])
        return
    for model in chosen:
        size = f", {model.size / 1e6:,.0f} MB" if model.size else ""
        gate = ", gated: accept its licence, and set HF_TOKEN" if model.is_gated else ""
        print(f"{model.name}: {model.purpose}; {KEYS[model.role]}: {model.backend}")
        print(f"    {model.weights}{size}{gate}")
        for file in model.files:
            if file.sha256:
                print(f"    {file.name}: sha256 {file.sha256}")
        print(f"    {model.licence}{f', forbids {model.forbids}' if model.forbids else ''}")
        if model.loaded_by:
            print(f"    loaded by {model.loaded_by}")
    if any(model.files for model in chosen):
        print("to fetch weights and to load them: pip install 'tableverse-factory[models]'", file=sys.stderr)


@models.command("fetch")
def fetch(names: Names = None, config: ForConfig = None, as_json: AsJson = False) -> None:
    """Fetch weights from the Hugging Face Hub into its cache, and check them before they are in place.

    Run it again to go on with what was broken off. HF_HOME, HF_ENDPOINT and HF_TOKEN are those of huggingface_hub.

    Example: `tableverse models fetch --config recipes/pictures-cpu.yaml`
    """
    from tableverse_factory.models.local.fetch import fetch_model

    rows = []
    for model in _choose(names or (), config):
        if not model.files and not names:
            print(f"{model.name} is not fetched here: {model.loaded_by}", file=sys.stderr)
            continue
        commit, files = fetch_model(model, lambda line: print(line, file=sys.stderr))
        rows.append({"name": model.name, "commit": commit, "files": [asdict(file) for file in files]})
        if not as_json:
            arrived = sum(file.size for file in files if file.how == "fetched")
            print(f"{model.name}: {f'{arrived / 1e6:,.1f} MB fetched and' if arrived else 'there,'} checked")
    if as_json:
        print_json(rows)


@models.command("check")
def check(names: Names = None, config: ForConfig = None, as_json: AsJson = False) -> None:
    """Check weights on this machine: present, missing or damaged. Needs no network.

    Fails if a model is damaged, or one that you name, or that the configuration uses, is missing.

    Example: `tableverse models check grounding-dino-tiny sam2.1-tiny`
    """
    from tableverse_factory.models.local.catalogue import CATALOGUE
    from tableverse_factory.models.local.weight_files import check_model

    are_wanted = bool(names or config)
    states = [check_model(model) for model in (_choose(names or (), config) if are_wanted else CATALOGUE)]
    if as_json:
        print_json(states)
    else:
        for state in states:
            print(f"{state.name}: {state.state}{f' in {state.folder}' if state.folder else ''}")
            for file in state.files:
                if file.state == "damaged" or (file.state == "missing" and state.state == "damaged"):
                    print(f"    {file.name}: {file.state}{f', {file.detail}' if file.detail else ''}")
    bad = [state.name for state in states if state.state == "damaged" or (are_wanted and state.state == "missing")]
    if bad:
        print(f"fetch them: tableverse models fetch {' '.join(bad)}", file=sys.stderr)
        raise typer.Exit(FAILED)


def _choose(names: Sequence[str], config: Path | None) -> tuple["ModelEntry", ...]:
    """Choose models by name and by what a configuration uses, each once."""
    from tableverse_factory.core.config import load_config
    from tableverse_factory.core.errors import InputError
    from tableverse_factory.models.local.catalogue import get_model
    from tableverse_factory.models.local.weight_files import find_models

    chosen = [get_model(name) for name in names]
    if config is not None:
        used, others = find_models(load_config(config))
        chosen += used
        for weights in others:
            print(f"{weights!r} is not in the table: it is neither fetched nor checked here", file=sys.stderr)
    elif not names:
        raise InputError("name models of `tableverse models list`, or give --config FILE")
    return tuple(dict.fromkeys(chosen))
