"""Rows of an image manifest in Arrow columns: checked a column at a time, and made when they are asked for."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, overload

import pyarrow as pa
import pyarrow.compute as pc

from schemas.identity import SAFE_ID
from schemas.manifest import ImageRow, SceneKind
from schemas.tables import MANIFEST
from tableverse_factory.dataset.columns import TextColumn

BATCH_ROWS = 64 * 1024  # of a table that is read
_LINES = 4096  # rows that are in Python or JSON at once
# Columns that finished datasets may lack: a row without them is hashed as in these
_LATER = ("family", "known_length", "parent", "recipe", "url")
_PARSED = {"known_length", "recipe"}  # columns of JSON, which `ImageRow` parses
_ESCAPED = r"[^ !#-\[\]-~]"  # characters that JSON in ASCII escapes


class ImageRows(Sequence[ImageRow]):
    """Valid manifest rows, which take some 300 bytes each: an `ImageRow` takes 2,000."""

    __slots__ = ("_columns", "_table")

    def __init__(self, table: pa.Table) -> None:
        """`table` has the schema MANIFEST, no nulls, and rows that are valid (see `find_valid`)."""
        self._table = table
        self._columns = {name: table[name] for name in MANIFEST.names}

    @classmethod
    def from_rows(cls, rows: Iterable[ImageRow]) -> "ImageRows":
        """Put rows into columns."""
        batches, part = [], []
        for row in rows:
            part.append(row)
            if len(part) == BATCH_ROWS:
                batches.append(_make_batch(part))
                part = []
        return cls(pa.Table.from_batches([*batches, _make_batch(part)]))

    def __len__(self) -> int:
        return int(self._table.num_rows)

    @overload
    def __getitem__(self, rank: int) -> ImageRow: ...
    @overload
    def __getitem__(self, rank: slice) -> "ImageRows": ...
    def __getitem__(self, rank: int | slice) -> "ImageRow | ImageRows":
        if isinstance(rank, slice):
            start, stop, step = rank.indices(len(self))
            if step != 1:
                return ImageRows.from_rows(self[place] for place in range(start, stop, step))
            return ImageRows(self._table.slice(start, max(stop - start, 0)))
        return ImageRow.model_validate({name: column[rank].as_py() for name, column in self._columns.items()})

    def __iter__(self) -> Iterator[ImageRow]:
        for batch in self._table.to_batches(_LINES):
            yield from map(ImageRow.model_validate, batch.to_pylist())

    def column(self, name: str) -> TextColumn:
        """Return the values of a field over all rows."""
        return TextColumn(self._columns[name])

    def encode_lines(self) -> Iterator[memoryview]:
        """Encode the rows in parts of many lines: each row as JSON with sorted keys, less empty ones of `_LATER`."""
        for batch in self._table.to_batches(_LINES):
            yield from _encode_lines(batch)


def as_image_rows(rows: Sequence[ImageRow]) -> ImageRows:
    """Return rows in columns: these, if they are so."""
    return rows if isinstance(rows, ImageRows) else ImageRows.from_rows(rows)


def find_valid(columns: Mapping[str, pa.Array]) -> pa.BooleanArray:
    """Find rows that plainly satisfy `ImageRow`, from columns of text by name; null stands for a missing value."""
    valid = pc.is_in(columns["kind"], pa.array([kind.value for kind in SceneKind]))
    checks = [pc.match_substring_regex(columns["scene_id"], f"^(?:{SAFE_ID.pattern})$")]
    checks += [pc.invert(pc.match_substring(columns["scene_id"], "..")), pc.is_valid(columns["uri"])]
    for name in _PARSED & columns.keys():
        checks.append(pc.equal(columns[name], "").fill_null(True))
    for name, column in columns.items():
        for bound in ImageRow.model_fields[name].metadata:
            if (longest := getattr(bound, "max_length", None)) is not None:
                checks.append(pc.less_equal(pc.utf8_length(column), longest).fill_null(True))
            if (pattern := getattr(bound, "pattern", None)) is not None:
                checks.append(pc.match_substring_regex(column, pattern).fill_null(True))
    for check in checks:
        valid = pc.and_(valid, check.fill_null(False))
    return valid


def _make_batch(rows: Sequence[ImageRow]) -> pa.RecordBatch:
    return pa.RecordBatch.from_pylist([row.model_dump(mode="json") for row in rows], schema=MANIFEST)


def _encode_lines(batch: pa.RecordBatch) -> Iterator[memoryview]:
    if not batch.num_rows:
        return
    parts: list[Any] = []
    odd = pa.scalar(False)
    for name in sorted(batch.schema.names):
        odd = pc.or_(odd, pc.match_substring_regex(batch[name], _ESCAPED))
        begin = f'{", " if parts else "{"}"{name}": "'
        if name in _LATER:
            told = pc.binary_join_element_wise(begin, batch[name], '"', "")
            parts.append(pc.if_else(pc.equal(batch[name], ""), "", told))
        else:
            parts += [begin, batch[name], '"']
    lines = pc.binary_join_element_wise(*parts, "}\n", "")
    if pc.any(odd).as_py():
        exact = pa.array([_encode_line(row) for row in batch.filter(odd).to_pylist()], pa.string())
        lines = pc.replace_with_mask(lines, odd, exact)
    _, offsets, data = lines.buffers()
    ends = memoryview(offsets).cast("i")
    yield memoryview(data)[ends[lines.offset] : ends[lines.offset + len(lines)]]


def _encode_line(row: Mapping[str, str]) -> str:
    return json.dumps({name: row[name] for name in row if name not in _LATER or row[name]}, sort_keys=True) + "\n"
