"""`tableverse config`: print or check the configuration."""

from tableverse_factory.cli.options import AsJson, ConfigFile, Overrides
from tableverse_factory.cli.tables import print_json


def config(file: ConfigFile = None, overrides: Overrides = None, as_json: AsJson = False) -> None:
    """Print every key with its meaning, or check a file.

    With --config or --set: the values that result; --json has their fingerprint too. `tableverse init` writes the
    same into a folder to begin in.

    Example: `tableverse config --config config.yaml --set run.seed=7`
    """
    from tableverse_factory.core.config import fingerprint_config, format_commented_yaml, load_config

    values = load_config(file, overrides or [])
    if as_json:
        print_json({"fingerprint": fingerprint_config(values), "config": values.model_dump(mode="json")})
    else:
        print(format_commented_yaml(values), end="")
