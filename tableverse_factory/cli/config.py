"""`tableverse config`: the configuration, written out."""

from pathlib import Path
from typing import Annotated

import typer


def config(
    file: Annotated[Path | None, typer.Option("--config", help="A configuration file to check.")] = None,
    overrides: Annotated[list[str] | None, typer.Option("--set", help="section.key=value, may repeat.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="The values as JSON, with their fingerprint.")] = False,
) -> None:
    """Print every key with its meaning, or check a file.

    With --config or --set: the values that result. `tableverse init` writes the same into a folder to begin in.

    Example: `tableverse config --config config.yaml --set run.seed=7`
    """
    import json

    from tableverse_factory.configuration import commented_yaml, fingerprint, load_config

    values = load_config(file, overrides or [])
    if as_json:
        print(json.dumps({"fingerprint": fingerprint(values), "config": values.model_dump(mode="json")}, indent=2))
    else:
        print(commented_yaml(values), end="")
