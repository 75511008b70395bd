"""Words for the completion of the shell, if they are cheap to find."""

from collections.abc import Iterable
from pathlib import Path

from typer import Context

MAX_WORDS = 200  # offered at once


def complete_scene_ids(context: Context, incomplete: str) -> list[str]:
    """List the finished scenes of the dataset on the command line, if it is local and readable."""
    from tableverse_factory.core.errors import TableverseError
    from tableverse_factory.dataset.dataset import open_dataset

    out = context.params.get("out") or next(iter(context.args), None)  # an option without its value ends the parsing
    if not isinstance(out, str) or not Path(out).is_dir():
        return []
    try:
        rows = open_dataset(out).scenes.to_table(columns=["scene_id", "status"]).to_pylist()
    except (TableverseError, OSError, ValueError):
        return []  # the command itself reports the error
    return _filter_prefix((row["scene_id"] for row in rows if row["status"] == "done"), incomplete)


def complete_config_keys(context: Context, incomplete: str) -> list[str]:
    """List `section.key=` for every key; for a finished dataset those of trajectories."""
    from tableverse_factory.core.config import list_keys

    section = "trajectories." if context.info_name == "trajectories" else ""
    return _filter_prefix((f"{key}=" for key in list_keys() if key.startswith(section)), incomplete)


def complete_columns(context: Context, incomplete: str) -> list[str]:
    """List the columns of the table, after those that are already typed."""
    from schemas.tables import TABLES

    table = str(context.params.get("table") or "scenes")
    written, comma, last = incomplete.rpartition(",")
    names = TABLES[table].names if table in TABLES else []
    return [f"{written}{comma}{name}" for name in _filter_prefix([*names, "all"], last)]


def complete_stages(context: Context, incomplete: str) -> list[str]:  # noqa: ARG001 Typer passes both by type
    """List the sections of the configuration that are stages."""
    from schemas.config import Config

    return _filter_prefix((name for name in Config.model_fields if name != "run"), incomplete)


def complete_textures(context: Context, incomplete: str) -> list[str]:  # noqa: ARG001 as above
    """List the families of table-tops, whose number follows."""
    from tableverse_factory.sources.textures.catalogue import FAMILIES

    return _filter_prefix((f"{family}-" for family in FAMILIES), incomplete)


def complete_models(context: Context, incomplete: str) -> list[str]:  # noqa: ARG001 as above
    """List the names of the models."""
    from tableverse_factory.models.local.catalogue import CATALOGUE

    return _filter_prefix((model.name for model in CATALOGUE), incomplete)


def _filter_prefix(words: Iterable[str], incomplete: str) -> list[str]:
    return [word for word in words if word.startswith(incomplete)][:MAX_WORDS]
