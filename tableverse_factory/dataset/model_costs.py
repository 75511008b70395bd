"""What a dataset's models cost, as its scenes say it: when each answer was first given, whoever asked for it then."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any

from schemas.arrow import SCENES
from schemas.outcome import NOTHING, Spent
from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.core.text import pluralize
from tableverse_factory.dataset.shards import read_shard, shard_path

MODEL_ROLE_BY_STAGE = {"perceive": "detector", "curate": "judge"}
"""Who asks a model, by stage: what its columns begin with."""

_FIGURES = ("calls", "input_tokens", "output_tokens", "usd")
COST_COLUMNS = tuple(f"{asker}_{figure}" for asker in MODEL_ROLE_BY_STAGE.values() for figure in _FIGURES)


def cost_columns(costs: Iterable[tuple[str, Spent]]) -> dict[str, Any]:
    """The columns of a scene, from what each of its stages spent; null where none was asked."""
    by_asker = {MODEL_ROLE_BY_STAGE[stage]: spent for stage, spent in costs if stage in MODEL_ROLE_BY_STAGE}
    return {
        f"{asker}_{figure}": getattr(by_asker[asker], figure) if asker in by_asker else None
        for asker in MODEL_ROLE_BY_STAGE.values()
        for figure in _FIGURES
    }


def costs(out: StoragePath, shards: Sequence[int]) -> dict[str, Spent]:
    """What each asker cost over all scenes of these committed shards, dropped and failed ones too."""
    rows: list[dict[str, Any]] = []
    for number in shards:
        with suppress(FileNotFoundError):  # a shard that is being written again counts when it is back
            rows += read_shard(shard_path(out, "scenes", number), SCENES, COST_COLUMNS).to_pylist()
    return costs_of(rows)


def format_cost(spent: Spent) -> str:
    """On one line; money only where prices are known."""
    price = f", {spent.usd:.4g} USD" if spent.usd else ""
    return f"{pluralize(spent.calls, 'call')}, {spent.input_tokens} tokens read, {spent.output_tokens} written{price}"


def costs_of(rows: Iterable[Mapping[str, Any]]) -> dict[str, Spent]:
    """What each asker cost over rows of scenes; without those that asked nothing."""
    sums = dict.fromkeys(MODEL_ROLE_BY_STAGE.values(), NOTHING)
    for row in rows:
        for asker in sums:
            sums[asker] += Spent(*(row[f"{asker}_{figure}"] or 0 for figure in _FIGURES))
    return {asker: spent for asker, spent in sums.items() if spent}
