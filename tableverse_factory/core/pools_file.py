"""Pools of a cluster, read from a file and completed to suit the configuration."""

import difflib
from pathlib import Path

from pydantic import ValidationError

from schemas.config import Config
from schemas.error_text import describe_validation_error
from schemas.pools import Pools, PoolSpec
from tableverse_factory.core.config import load_yaml
from tableverse_factory.core.errors import ConfigError

IDLE_ACTOR_CPUS = 0.25  # CPUs of an actor that mostly waits for a model's answer


def load_pools(path: Path | None, config: Config) -> Pools:
    """Load the pools of a build from YAML, a section per pool; those that ask a remote model take fewer CPUs."""
    tree = {} if path is None else load_yaml(path)
    for pool, section in (("perception", config.perceive), ("curation", config.curate)):
        if section.protocol:
            tree.setdefault(pool, PoolSpec(cpus=IDLE_ACTOR_CPUS).model_dump(exclude_defaults=True))
    try:
        return Pools.model_validate(tree)
    except ValidationError as error:
        pools, keys = ", ".join(Pools.model_fields), ", ".join(PoolSpec.model_fields)
        raise ConfigError(
            f"{path}: {describe_validation_error(error)}{_suggest_name(error)} (pools are {pools}; each has {keys})"
        ) from None


def _suggest_name(error: ValidationError) -> str:
    first = error.errors(include_url=False)[0]
    if first["type"] != "extra_forbidden":
        return ""
    known = Pools.model_fields if len(first["loc"]) == 1 else PoolSpec.model_fields
    close = difflib.get_close_matches(str(first["loc"][-1]), known, n=1)
    return f"; did you mean {close[0]}?" if close else ""
