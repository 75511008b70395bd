"""Reader of the image manifest: one valid row for each of its rows, with unique ids."""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pyarrow as pa
from pydantic import ValidationError

from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.core.errors import InputError, StoreError
from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.core.storage.parquet import read_table
from tableverse_factory.core.text import describe_validation_error

REQUIRED_COLUMNS = ("scene_id", "kind", "uri")
_MAX_TEXT = 500


def read_manifest(path: StoragePath) -> list[ImageRow]:
    """Read the manifest's rows in their order; other columns are ignored.

    An invalid row becomes a rejected one with an id of its own (`invalid-…`), as does a row with a repeated id
    (`duplicate-…`): both are dropped in the dataset at stage `manifest`.
    """
    records = _read_records(path)
    rows: list[ImageRow] = []
    first: dict[str, int] = {}
    for number, record in enumerate(records):
        row = _parse_row(record, number)
        if row.scene_id in first:
            row = _mark_duplicate(row, first[row.scene_id], number)
        first[row.scene_id] = number
        rows.append(row)
    return rows


def _read_records(path: StoragePath) -> list[dict[str, Any]]:
    if isinstance(path, Path) and path.is_dir():
        if (path / "run.json").is_file():
            raise InputError(f"{path} is a dataset: the manifest comes first, tableverse build MANIFEST {path}")
        raise InputError(f"{path} is a folder: {_manifest_hint(path)}")
    try:
        table = read_table(path)
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; {_manifest_hint(name=path.name)}") from None
    except StoreError:
        raise
    except (OSError, pa.ArrowException) as error:
        why = " ".join(str(error).split())[:300]
        raise InputError(f"{path} is no Parquet file: {why}; {_manifest_hint()}") from error
    missing = [name for name in REQUIRED_COLUMNS if name not in table.column_names]
    if missing:
        there = ", ".join(table.column_names)[:300]
        raise InputError(f"{path} lacks the columns {', '.join(missing)}: it has {there}; {_manifest_hint()}")
    return table.select([n for n in ImageRow.model_fields if n in table.column_names]).to_pylist()


def _manifest_hint(folder: Path | str = "FOLDER", name: str = "images.parquet") -> str:
    return f"`tableverse manifest {folder} --out {name}` makes a manifest"


def _parse_row(record: dict[str, Any], number: int) -> ImageRow:
    given = {key: value for key, value in record.items() if value is not None}
    try:
        return ImageRow.model_validate(given)
    except ValidationError as error:
        detail = f"row {number}: {describe_validation_error(error)}"
    kinds: Sequence[str] = [kind.value for kind in SceneKind]
    kind = SceneKind(record["kind"]) if record.get("kind") in kinds else SceneKind.IMAGE
    content = json.dumps([number, given], sort_keys=True, default=str)
    return ImageRow(
        scene_id=f"invalid-{_short_hash(content)}",
        kind=kind,
        uri=str(record.get("uri"))[:_MAX_TEXT],
        name=str(record.get("name") or "")[:_MAX_TEXT],
        rejected="invalid_manifest_row",
        rejected_detail=" ".join(detail.split())[:2000],
    )


def _mark_duplicate(row: ImageRow, first: int, number: int) -> ImageRow:
    return row.model_copy(
        update={
            "scene_id": f"duplicate-{_short_hash(f'{number}:{row.scene_id}')}",
            "rejected": "duplicate_scene_id",
            "rejected_detail": f"row {number} repeats the scene_id {row.scene_id} of row {first}",
        }
    )


def _short_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
