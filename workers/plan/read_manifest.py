"""Reader of the image manifest: one valid row for each of its rows, with unique ids."""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray
from pydantic import ValidationError

from schemas.error_text import describe_validation_error
from schemas.manifest import REQUIRED_COLUMNS, ImageRow, SceneKind
from schemas.tables import MANIFEST
from tableverse_factory.core.errors import InputError, StoreError
from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.core.storage.parquet import open_parquet
from tableverse_factory.dataset.columns import HashIndex, TextColumn
from tableverse_factory.dataset.image_rows import BATCH_ROWS, ImageRows, find_valid

_MAX_TEXT = 500
_DUPLICATE = "duplicate-"


def read_manifest(path: StoragePath) -> ImageRows:
    """Read the manifest's rows in their order; other columns are ignored.

    An invalid row becomes a rejected one with an id of its own (`invalid-…`), as does a row with a repeated id
    (`duplicate-…`): both are dropped in the dataset at stage `manifest`.
    """
    _refuse_folder(path)
    parsed, number = [], 0
    try:
        for batch in _read_batches(path):
            parsed.append(_parse_batch(batch, number))
            number += batch.num_rows
    except FileNotFoundError:
        raise InputError(f"{path} does not exist; {_manifest_hint(name=path.name)}") from None
    except StoreError:
        raise
    except (OSError, pa.ArrowException, ValueError, OverflowError) as error:
        why = " ".join(str(error).split())[:300]
        raise InputError(f"{path} is no Parquet file: {why}; {_manifest_hint()}") from error
    return ImageRows(_reject_duplicates(pa.Table.from_batches(parsed, MANIFEST)))


def _refuse_folder(path: StoragePath) -> None:
    if isinstance(path, Path) and path.is_dir():
        if (path / "run.json").is_file():
            raise InputError(f"{path} is a dataset: the manifest comes first, tableverse build MANIFEST {path}")
        raise InputError(f"{path} is a folder: {_manifest_hint(path)}")


def _read_batches(path: StoragePath) -> Iterator[pa.RecordBatch]:
    """Read the columns of a manifest row, some thousand rows at a time."""
    with open_parquet(path) as file:
        there = file.schema_arrow.names
        missing = [name for name in REQUIRED_COLUMNS if name not in there]
        if missing:
            has = ", ".join(there)[:300]
            raise InputError(f"{path} lacks the columns {', '.join(missing)}: it has {has}; {_manifest_hint()}")
        twice = sorted({name for name in MANIFEST.names if there.count(name) > 1})
        if twice:
            raise InputError(f"{path} has several columns {', '.join(twice)}: give one of each; {_manifest_hint()}")
        yield from file.iter_batches(BATCH_ROWS, columns=[name for name in MANIFEST.names if name in there])


def _manifest_hint(folder: Path | str = "FOLDER", name: str = "images.parquet") -> str:
    return f"`tableverse manifest {folder} --out {name}` makes a manifest"


def _parse_batch(batch: pa.RecordBatch, first: int) -> pa.RecordBatch:
    """Make valid rows of a batch that begins at row `first`; only rows that are not plainly valid are parsed singly."""
    found = {name: _as_text(batch[name]) for name in batch.schema.names}
    columns = {name: column for name, column in found.items() if column is not None}
    nothing = pa.repeat("", batch.num_rows)
    filled = [columns[name].fill_null("") if name in columns else nothing for name in MANIFEST.names]
    texts = pa.RecordBatch.from_arrays(filled, schema=MANIFEST)
    valid = find_valid(columns) if len(columns) == len(found) else pa.repeat(False, batch.num_rows)
    doubtful = np.flatnonzero(~valid.to_numpy(zero_copy_only=False))
    if not len(doubtful):
        return texts
    given = pa.RecordBatch.from_pydict({name: columns.get(name, batch[name]) for name in found})
    values = ([_to_python(value) for value in column] for column in given.take(pa.array(doubtful)))
    records = (dict(zip(found, record, strict=True)) for record in zip(*values, strict=True))
    rows = [_parse_row(record, first + place) for record, place in zip(records, doubtful.tolist(), strict=True)]
    return _replace_rows(texts, doubtful, [row.model_dump(mode="json") for row in rows])


def _as_text(column: pa.Array) -> pa.Array | None:
    """Return a column as text; None if it holds anything else."""
    kind = column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    if not (pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind)):
        return None
    text = column.cast(pa.string())
    text.validate(full=True)
    return text


def _to_python(value: pa.Scalar) -> Any:
    """Return a value as Python's; as its type, which is no text either, if Python's own types cannot hold it."""
    kind = value.type
    try:
        if value.is_valid and "[ns" in str(kind):  # nanoseconds become pandas' types where that is installed
            value = value.cast(_to_microseconds(kind))
        return value.as_py()
    except (ValueError, OverflowError):  # parts of a microsecond, a year after 9999, an unknown time zone
        return kind


def _to_microseconds(kind: pa.DataType) -> pa.DataType:
    if pa.types.is_timestamp(kind):
        return pa.timestamp("us", kind.tz)
    if pa.types.is_time64(kind):
        return pa.time64("us")
    if pa.types.is_duration(kind):
        return pa.duration("us")
    raise ValueError(f"{kind} holds nanoseconds within")


def _replace_rows(
    batch: pa.RecordBatch, places: NDArray[np.int64], values: Sequence[Mapping[str, str]]
) -> pa.RecordBatch:
    """Replace the values at ascending places of a batch, in the columns that the values have."""
    mask = np.zeros(batch.num_rows, bool)
    mask[places] = True
    columns = {name: batch[name] for name in batch.schema.names}
    for name in values[0]:
        news = pa.array([value[name] for value in values], pa.string())
        columns[name] = pc.replace_with_mask(columns[name], pa.array(mask), news)
    return pa.RecordBatch.from_pydict(columns, schema=batch.schema)


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


def _reject_duplicates(table: pa.Table) -> pa.Table:
    """Reject rows with the id of an earlier row under ids of their own."""
    ids = TextColumn(table["scene_id"])
    news = _rename_duplicates(ids)
    if not news:
        return table
    batches, start = [], 0
    for batch in table.to_batches():
        places = [number for number in range(start, start + batch.num_rows) if number in news]
        if places:
            batch = _replace_rows(batch, np.array(places) - start, [news[number] for number in places])
        batches.append(batch)
        start += batch.num_rows
    return pa.Table.from_batches(batches, table.schema)


def _rename_duplicates(ids: TextColumn) -> dict[int, dict[str, str]]:
    """Make new values of rows with a repeated id, by row number."""
    given = pc.starts_with(ids.values, _DUPLICATE).to_numpy()  # a new id could meet these
    first: dict[str, int] = {}
    news = {}
    for number in sorted({*HashIndex(ids).find_shared(), *np.flatnonzero(given).tolist()}):
        scene_id = ids[number]
        if scene_id in first:
            detail = f"row {number} repeats the scene_id {scene_id} of row {first[scene_id]}"
            while scene_id in first:
                scene_id = f"{_DUPLICATE}{_short_hash(f'{number}:{scene_id}')}"
            news[number] = {"scene_id": scene_id, "rejected": "duplicate_scene_id", "rejected_detail": detail}
        first[scene_id] = number
    return news


def _short_hash(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()[:16]
