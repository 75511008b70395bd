"""Dataset filtered by license for redistribution: shards are rewritten, each remaining scene byte for byte the same."""

import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from urllib.parse import unquote, urlsplit, urlunsplit

import pyarrow as pa

from schemas.identity import content_hash
from schemas.tables import SCENES, STORED_TABLES
from tableverse_factory.core.errors import BuildError, InputError, StoreError
from tableverse_factory.core.storage.files import StoragePath, atomic_file, list_names, open_stream, write_atomic
from tableverse_factory.core.storage.parquet import build_table, encode_parquet, read_table
from tableverse_factory.dataset.card import make_dataset_card
from tableverse_factory.dataset.consolidated_tables import write_merged_tables
from tableverse_factory.dataset.licences import PROFILES, LicenceVerdict, scene_license
from tableverse_factory.dataset.shard_plan import Plan, read_plan, write_plan
from tableverse_factory.dataset.shards import SPARSE, TarShard, committed_shards, shard_path, tar_sort_key
from tableverse_factory.models.local.catalogue import DEFAULT_WEIGHTS
from tableverse_factory.models.local.hf_weights import parse_hub_name
from tableverse_factory.run_record import diff_run_records, read_run, resume_refused_error, write_run

# Files of an export that was killed before `run.json`
_LEFTOVER_FILES = frozenset({"plan.parquet", "plan.parquet.partial", "run.json.partial", ".work"})
_PRIVATE_SUFFIXES = ("_dir", "_url")  # of configuration keys that name the builder's own paths and addresses
_PLAIN_NAME = re.compile(r"[\w.+-]+")
_REDACTED = "…"  # replaces each word of a command
Row = dict[str, Any]


@dataclass(frozen=True, slots=True)
class FilterResult:
    """Numbers of scenes in a filtered dataset, and of those left out by verdict."""

    kept: int  # with a row
    done: int  # with files
    left_out: Mapping[LicenceVerdict, int]


def write_filtered_dataset(out: StoragePath, dest: StoragePath, profile: str, unfinished: bool = False) -> FilterResult:
    """Write the scenes of a dataset that a profile allows to another folder; may be repeated after a kill.

    Scenes that are left out leave no trace: no row, no address, no `detail` or `recipe` that could name them. Private
    parts of `uri` (see `redact_uri`) and of the configuration (see `redact_config`) are removed. The caller holds the
    lock of `dest`: a new or empty folder, or one where the same export was begun. `profile` is one of
    `licences.PROFILES`. Of a dataset that is not finished, the finished shards are written if it may be `unfinished`.
    """
    run, plan = read_run(out / "run.json"), read_plan(out / "plan.parquet")
    finished = sorted(committed_shards(out).intersection(range(plan.n_shards)))
    missing = plan.n_shards - len(finished)
    if missing and not (unfinished and finished):
        or_option = ", or give --unfinished for the others" if finished else ""
        raise BuildError(
            f"{out} is not finished: {missing} of {plan.n_shards} shards are missing; build on first{or_option}"
        )
    shards, left_out = _select_rows(out, finished, profile)
    kept = [row for _, rows in shards for row in rows]
    if not kept:
        raise InputError(_explain_nothing(profile, left_out), "nothing_to_publish")
    digest = content_hash(json.dumps(shards, sort_keys=True).encode())
    published = {"profile": profile, "scenes": len(kept), "rows_sha256": digest}
    record = {**run, "config": redact_config(run.get("config", {})), "published": published}
    _start_dataset(dest, record, shards)
    there = committed_shards(dest)
    for number, (source, rows) in enumerate(shards):
        if number not in there:
            _write_shard(out, source, dest, number, rows)
    write_merged_tables(dest, len(shards))
    write_atomic(dest / "README.md", make_dataset_card(dest, record, range(len(shards))).encode())
    return FilterResult(len(kept), sum(row["status"] == "done" for row in kept), left_out)


def _select_rows(
    out: StoragePath, numbers: Iterable[int], profile: str
) -> tuple[list[tuple[int, list[Row]]], Counter[LicenceVerdict]]:
    """Select rows of shards that may be redistributed, by shard number, without empty shards."""
    allowed, left_out = PROFILES[profile], Counter[LicenceVerdict]()
    shards: list[tuple[int, list[Row]]] = []
    for number in numbers:
        rows = []
        for row in _read_rows(out, "scenes", number):
            verdict = scene_license(row)
            if verdict in allowed:
                places = {"uri": redact_uri(row["uri"] or ""), "url": redact_uri(row["url"] or "") or None}
                silenced = {"detail": None, "recipe": None}  # either may name a scene that is left out
                rows.append({**row, **places, **silenced, "licence_verdict": verdict.value})
            else:
                left_out[verdict] += 1
        if rows:
            shards.append((number, rows))
    return shards, left_out


def _explain_nothing(profile: str, left_out: Mapping[LicenceVerdict, int]) -> str:
    counts = ", ".join(f"{count} {verdict.value}" for verdict, count in sorted(left_out.items()))
    return (
        f"no scene may be passed on as {profile}: {counts}. A licence is stated where the input lies: in source.json "
        'of a capture or a folder, or NAME.source.json beside a file, as {"source": "…", "licence": "CC-BY-4.0"}; then '
        "make the manifest again and build into a new OUT"
    )


def _start_dataset(dest: StoragePath, record: Mapping[str, Any], shards: Sequence[tuple[int, Sequence[Row]]]) -> None:
    run_json = dest / "run.json"
    if run_json.exists():
        if differing := diff_run_records(read_run(run_json), record):
            raise resume_refused_error(str(dest), differing, "")
        return
    if dest.is_file() or not _LEFTOVER_FILES.issuperset(list_names(dest)):
        raise BuildError(f"{dest} holds something else: give a new or an empty folder")
    placed = [(row, number) for number, (_, rows) in enumerate(shards) for row in rows]
    ids, kinds = (tuple(str(row[key]) for row, _ in placed) for key in ("scene_id", "kind"))
    write_plan(dest / "plan.parquet", Plan(ids, kinds, tuple(number for _, number in placed)))
    write_run(run_json, record)


def _write_shard(out: StoragePath, source: int, dest: StoragePath, number: int, rows: Sequence[Row]) -> None:
    """Write one shard, its scenes file last as the commit."""
    places: dict[str, tuple[int, int]] = {}
    with open_stream(shard_path(out, "mjcf", source)) as old, atomic_file(shard_path(dest, "mjcf", number)) as file:
        tar = TarShard(file)
        for row in sorted(rows, key=lambda row: tar_sort_key(row["scene_id"])):
            if row["tar_offset"] is not None:
                places[row["scene_id"]] = tar.copy(old, row["tar_offset"], row["tar_size"])
        tar.close()
    kept = {row["scene_id"] for row in rows}
    for table in ("objects", "tasks", "timings", "trajectories"):
        own = [row for row in _read_rows(out, table, source) if row["scene_id"] in kept]
        if own or table not in SPARSE:
            write_atomic(shard_path(dest, table, number), encode_parquet(build_table(own, STORED_TABLES[table])))
    scenes = []
    for row in rows:
        offset, size = places.get(row["scene_id"], (None, None))
        scenes.append({**row, "shard": number, "tar_offset": offset, "tar_size": size})
    write_atomic(shard_path(dest, "scenes", number), encode_parquet(build_table(scenes, SCENES)))


def redact_uri(uri: str) -> str:
    """Reduce a web address to scheme, host and path, and anything else to its last name."""
    try:
        parts = urlsplit(uri)
        on_the_web = parts.scheme in ("http", "https") and bool(parts.hostname) and parts.port != 0
    except ValueError:  # it is undecidable where the host ends and a password begins
        return ""
    if on_the_web:
        return urlunsplit((parts.scheme, parts.netloc.rpartition("@")[2], parts.path, "", ""))
    return re.split(r"[/\\]", unquote(parts.path) if "://" in uri else uri)[-1]


def redact_config(config: Mapping[str, Any]) -> dict[str, Any]:
    """Empty paths and addresses of a configuration, and all words of commands except the program's name.

    The robot's file, local weights and programs keep their last name; weights of the hub stay as they are. A redacted
    configuration stays unchanged.
    """
    return {key: _redact_value(key, value, config) for key, value in config.items()}


def _redact_value(key: str, value: Any, section: Mapping[str, Any]) -> Any:
    if isinstance(value, Mapping):
        return redact_config(value)
    if key.endswith(_PRIVATE_SUFFIXES):
        return ""
    if key.endswith("_command"):
        return [_redact_program(str(word)) if place == 0 else _REDACTED for place, word in enumerate(value)]
    if key.endswith("_weights"):
        fetched = section.get(key.removesuffix("_weights")) in DEFAULT_WEIGHTS  # the others read files of ours
        on_hub = fetched and parse_hub_name(str(value)) is not None
        return value if on_hub else _strip_folders(str(value))
    return redact_uri(str(value)) if key == "robot" else value


def _redact_program(word: str) -> str:
    """Keep a program's plain name; arguments may hold tokens, hosts and folders in any form."""
    name = _strip_folders(word)
    return name if _PLAIN_NAME.fullmatch(name) else _REDACTED


def _strip_folders(path: str) -> str:
    return re.split(r"[/\\]", path.rstrip("/\\"))[-1]


def _read_rows(out: StoragePath, table: str, number: int) -> list[Row]:
    path = shard_path(out, table, number)
    try:
        return read_table(path, STORED_TABLES[table]).to_pylist()
    except StoreError:
        raise
    except (OSError, pa.ArrowException) as error:
        if table in SPARSE and isinstance(error, FileNotFoundError):
            return []
        raise InputError(f"{path} cannot be read: {' '.join(str(error).split())[:300]}") from error
