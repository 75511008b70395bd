"""Input of a finished dataset, restored from the dataset alone: its configuration and its manifest's rows."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from pydantic import ValidationError

from schemas.config import Config
from schemas.error_text import describe_validation_error
from schemas.manifest import ImageRow
from tableverse_factory.core.config import build_config
from tableverse_factory.core.errors import BuildError, ConfigError
from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.dataset.committed_rows import read_shard
from tableverse_factory.dataset.image_rows import ImageRows
from tableverse_factory.dataset.shard_plan import Plan, digest_manifest
from tableverse_factory.dataset.shards import committed_shards, shard_path

MANIFEST_STAGE = "manifest"
_COLUMNS = (
    *("scene_id", "kind", "uri", "name", "content_sha256", "url", "source", "licence", "known_length"),
    *("parent", "family", "recipe", "stage", "reason", "detail"),
)


def config_from_run(run: Mapping[str, Any], section: str, overrides: Sequence[str] = ()) -> Config:
    """Restore the configuration of a dataset as far as an added stage reads it.

    Sections of other stages that this version rejects, or that were emptied before publication, get their defaults:
    nothing reads them, and run.json keeps its values. `overrides`, such as `trajectories.tries=6`, are of `section`.
    """
    if others := [text for text in overrides if text.partition(".")[0].strip() != section]:
        raise ConfigError(
            f"override {others[0][:80]!r}: only {section}.… can be set here; all else is as the dataset was built"
        )
    tree = run.get("config")
    if not isinstance(tree, Mapping):
        raise ConfigError("run.json: it holds no configuration")
    try:
        return build_config(tree, overrides, "run.json: ")
    except ConfigError:
        return build_config({name: tree[name] for name in ("run", section) if name in tree}, overrides, "run.json: ")


def manifest_from_dataset(out: StoragePath, run: Mapping[str, Any], plan: Plan) -> ImageRows:
    """Restore the manifest rows that a finished dataset was built from, in the plan's order.

    The digest in run.json verifies them. A dataset written by `tableverse export` holds only what may be passed on: its
    own rows count as its manifest. BuildError if it is not finished, or its rows are not those of the manifest.
    """
    committed = committed_shards(out)
    if missing := [shard for shard in range(plan.n_shards) if shard not in committed]:
        raise BuildError(
            f"{out} is not finished: {len(missing)} of {plan.n_shards} shards are missing, so not all rows of its "
            "manifest are known: go on with `tableverse build MANIFEST OUT`, with --stages +trajectories for both"
        )
    rows = ImageRows.from_rows(_iterate_rows(out, plan))
    if "published" not in run and digest_manifest(rows) != run["manifest"]["sha256"]:
        raise _make_restore_error(out, "the rows of scenes/ are not those that run.json was written for")
    return rows


def _iterate_rows(out: StoragePath, plan: Plan) -> Iterator[ImageRow]:
    """Read the rows of one shard after the other, each in the plan's order."""
    for shard, ranks in enumerate(plan.members()):
        rows = {row.scene_id: row for row in read_manifest_rows(out, shard)}
        for scene_id in plan.scene_ids[ranks.start : ranks.stop]:
            if scene_id not in rows:
                raise _make_restore_error(out, f"{scene_id} has no row")
            yield rows[scene_id]


def _make_restore_error(out: StoragePath, why: str) -> BuildError:
    return BuildError(
        f"{out}: the manifest cannot be restored ({why}): give it, with `tableverse build MANIFEST OUT --stages "
        "+trajectories` and what the dataset was built with"
    )


def read_manifest_rows(out: StoragePath, shard: int) -> list[ImageRow]:
    """Read the manifest rows of the scenes of a committed shard."""
    try:
        return [_make_manifest_row(record) for record in read_shard(out, "scenes", shard, _COLUMNS).to_pylist()]
    except ValidationError as error:
        path = shard_path(out, "scenes", shard)
        raise BuildError(f"{path}: no row of a manifest: {describe_validation_error(error)}") from error


def _make_manifest_row(record: Mapping[str, Any]) -> ImageRow:
    """Make a scene's manifest row, with the reason if it was rejected."""
    rejected = record["stage"] == MANIFEST_STAGE
    own = {name: record[name] or "" for name in ImageRow.model_fields if name in record}
    own["family"] = own["family"] if own["parent"] else ""  # others are their own
    why = {"rejected": record["reason"] or "", "rejected_detail": record["detail"] or ""} if rejected else {}
    return ImageRow.model_validate({**own, **why})
