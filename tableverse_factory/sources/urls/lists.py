"""Lists of addresses: CSV, JSON lines or Parquet with url, source, licence and known_length; all untrusted."""

import csv
import io
import json
import os
import posixpath
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from schemas.known_length import MAX_CHARS as MAX_KNOWN_LENGTH_CHARS
from schemas.manifest import REQUIRED_COLUMNS
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import redact_uri
from tableverse_factory.core.storage.untrusted import parse_json, read_bytes
from tableverse_factory.core.text import describe_error, sanitize_line
from tableverse_factory.sources.urls.addresses import MAX_URL_CHARS

LIST_SUFFIXES = (".csv", ".jsonl", ".parquet")
MAX_LIST_BYTES = 512 * 1024 * 1024
MAX_ROWS = 1_000_000
MAX_SOURCE_CHARS = 2048
MAX_LICENCE_CHARS = 512
COLUMN_ALIASES = {name: name for name in ("url", "source", "licence", "known_length")} | {"license": "licence"}
"""Columns, and keys of `source.json`, by their lower-case names."""

_OTHER_DELIMITERS = {";": "semicolons", "\t": "tabs", "|": "bars"}
_LIMITS = {
    "url": MAX_URL_CHARS,
    "source": MAX_SOURCE_CHARS,
    "licence": MAX_LICENCE_CHARS,
    "known_length": MAX_KNOWN_LENGTH_CHARS,
}
_OBJECTS = ("known_length",)  # JSON lines hold them as they are
_REASONS = {"url": "bad_url", "known_length": "bad_known_length"}
_MAX_SHOWN_NAMES, _NAME_CHARS = 20, 60
_BATCH_ROWS = 4096

Row = TypeVar("Row")


@dataclass(frozen=True, slots=True)
class ListRow:
    """One row of a list.

    Attributes:
        url: As it stands there, at most `MAX_URL_CHARS` characters; it may hold a secret and is never shown as it is.
        problem: Code and detail of the reason why the row cannot be used; else None.
    """

    url: str
    source: str = ""
    licence: str = ""
    known_length: str = ""
    problem: tuple[str, str] | None = None


@dataclass(frozen=True, slots=True)
class UrlList:
    """Rows of a list in order, and the names of the ignored columns."""

    rows: tuple[ListRow, ...]
    ignored: tuple[str, ...]


def is_list(path: str) -> bool:
    """Check whether a path has the suffix of a list and is no folder."""
    return posixpath.splitext(path)[1].lower() in LIST_SUFFIXES and not os.path.isdir(path)  # noqa: PTH112 Path.is_dir raises for some hostile names


def read_list(path: str) -> UrlList:
    """Read a list; a row that cannot be used keeps its place and says why."""
    name, data = redact_uri(path), read_bytes(path, MAX_LIST_BYTES, "unreadable_list")
    suffix = posixpath.splitext(path)[1].lower()
    try:
        if suffix == ".parquet":
            return _parse_parquet(name, data)
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"{name} is no list of addresses: {describe_error(error)}", "unreadable_list") from None
    return _parse_csv(name, text) if suffix == ".csv" else _parse_json_lines(name, text)


def _parse_csv(name: str, text: str) -> UrlList:
    before = csv.field_size_limit(len(text) + 1)  # of the whole process; a long cell is one bad row, not a bad file
    try:
        reader = csv.reader(io.StringIO(text, newline=""))
        header = next(reader, [])
        _check_delimiter(name, header)
        known = _match_columns(name, header)
        cells = {column: header.index(given) for column, given in known.items()}
        rows = [
            _make_row({column: line[cell] for column, cell in cells.items() if cell < len(line)})
            for line in _limit_rows(name, (line for line in reader if line))
        ]
    except csv.Error as error:
        raise InputError(f"{name} is no CSV: {describe_error(error)}", "unreadable_list") from None
    finally:
        csv.field_size_limit(before)
    return UrlList(tuple(rows), _find_other_columns(header, known))


def _check_delimiter(name: str, header: list[str]) -> None:
    for sign, called in _OTHER_DELIMITERS.items():
        if len(header) == 1 and sign in header[0]:
            raise InputError(f"{name} has {called} between its columns: give commas", "unreadable_list")


def _limit_rows(name: str, rows: Iterable[Row]) -> Iterator[Row]:
    for number, row in enumerate(rows):
        if number == MAX_ROWS:
            raise _too_many_rows_error(name)
        yield row


def _parse_json_lines(name: str, text: str) -> UrlList:
    rows: list[ListRow] = []
    others: dict[str, None] = {}
    for number, line in enumerate(_limit_rows(name, (line for line in text.split("\n") if line.strip())), 1):
        try:
            value = parse_json(line.encode(), f"row {number}", "bad_list_row")
        except InputError as error:
            rows.append(ListRow("", problem=(error.reason, sanitize_line(str(error), 500))))
            continue
        if not isinstance(value, Mapping):
            rows.append(ListRow("", problem=("bad_list_row", f"row {number} is no object of names and texts")))
            continue
        known = {column: given for given in value if (column := COLUMN_ALIASES.get(given.strip().lower()))}
        others |= dict.fromkeys(given for given in value if given not in known.values())
        rows.append(_make_row({column: value[given] for column, given in known.items()}))
    if rows and not any(row.url for row in rows):
        raise InputError(
            f'{name}: no line has a "url": give {{"url": …, "source": …, "licence": …}}', "unreadable_list"
        )
    return UrlList(tuple(rows), tuple(sanitize_line(given, _NAME_CHARS) for given in others))


def _parse_parquet(name: str, data: bytes) -> UrlList:
    try:
        with pq.ParquetFile(pa.BufferReader(data)) as file:
            schema = file.schema_arrow
        if set(REQUIRED_COLUMNS).issubset(schema.names):
            raise InputError(f"{name} is a manifest already: give it to tableverse build", "unreadable_list")
        known = _match_columns(name, schema.names)
        for given in known.values():
            if schema.names.count(given) > 1 or pa.types.is_nested(schema.field(given).type):
                raise InputError(f"{name} has no one column {given} of text", "unreadable_list")
        # Equal cells stay one cell until their lengths are known: a small file may hold a million long ones.
        with pq.ParquetFile(pa.BufferReader(data), read_dictionary=list(known.values())) as file:
            rows = tuple(_read_parquet_rows(name, file, known))
    except (pa.ArrowException, OSError) as error:
        raise InputError(f"{name} is no Parquet file: {describe_error(error)[:300]}", "unreadable_list") from None
    return UrlList(rows, _find_other_columns(schema.names, known))


def _read_parquet_rows(name: str, file: pq.ParquetFile, known: Mapping[str, str]) -> Iterator[ListRow]:
    """Read the rows in batches; sizes that the file states are not trusted."""
    count = size = 0
    for batch in file.iter_batches(_BATCH_ROWS, columns=list(known.values()), use_threads=False):
        count += batch.num_rows
        size += sum(_measure_column(batch.column(given)) for given in known.values())
        if count > MAX_ROWS:
            raise _too_many_rows_error(name)
        if size > MAX_LIST_BYTES:
            raise InputError(f"{name} holds more than {MAX_LIST_BYTES} bytes when unpacked", "unreadable_list")
        columns = {column: batch.column(given).to_pylist() for column, given in known.items()}
        for number in range(batch.num_rows):
            yield _make_row({column: cells[number] for column, cells in columns.items()})


def _measure_column(column: pa.Array) -> int:
    """Measure the unpacked size of a column before unpacking it [bytes]."""
    if not pa.types.is_dictionary(column.type):
        return int(column.nbytes)
    lengths = pc.binary_length(column.dictionary)
    return int(pc.sum(lengths.take(column.indices)).as_py() or 0)


def _match_columns(name: str, header: list[str]) -> dict[str, str]:
    known: dict[str, str] = {}
    for given in header:
        column = COLUMN_ALIASES.get(given.strip().lower())
        if column is not None and known.setdefault(column, given) != given:
            raise InputError(f"{name} has two columns for {column}: {known[column]!r} and {given!r}", "unreadable_list")
    if "url" not in known:
        columns = summarize_names(sanitize_line(given, _NAME_CHARS) for given in header) or "no columns"
        remedy = "a list has url, and source, licence and known_length where they are known"
        raise InputError(f"{name} has no column url: it has {columns}; {remedy}", "unreadable_list")
    return known


def _find_other_columns(header: list[str], known: Mapping[str, str]) -> tuple[str, ...]:
    return tuple(sanitize_line(given, _NAME_CHARS) for given in header if given not in known.values())


def summarize_names(names: Iterable[str]) -> str:
    """List the first names, and how many more there are; empty if there are none."""
    every = list(names)
    more = f" and {len(every) - _MAX_SHOWN_NAMES} more" if len(every) > _MAX_SHOWN_NAMES else ""
    return ", ".join(every[:_MAX_SHOWN_NAMES]) + more


def _make_row(cells: Mapping[str, Any]) -> ListRow:
    """Make a row; a cell that is no text within its bound becomes the row's problem."""
    texts: dict[str, str] = {}
    for column, value in cells.items():
        text = "" if value is None else json.dumps(value) if column in _OBJECTS and isinstance(value, dict) else value
        if not isinstance(text, str) or len(text) > _LIMITS[column]:
            is_text = isinstance(text, str)
            actual = f"{len(text)} characters" if is_text else f"no text but of the type {type(text).__name__}"
            detail = f"{column} is {actual}; give text of at most {_LIMITS[column]} characters"
            return ListRow(texts.get("url", ""), problem=(_REASONS.get(column, "bad_source"), detail))
        texts[column] = text.strip() if column == "url" else sanitize_line(text.strip(), _LIMITS[column])
    if not texts.get("url"):
        return ListRow("", problem=("bad_url", "there is no address"))
    return ListRow(texts["url"], texts.get("source", ""), texts.get("licence", ""), texts.get("known_length", ""))


def _too_many_rows_error(name: str) -> InputError:
    return InputError(f"{name} has more than {MAX_ROWS} rows: split it", "unreadable_list")
