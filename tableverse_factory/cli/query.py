"""`tableverse query`: rows of a table that meet a condition."""

import csv
import io
import json
import math
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tableverse_factory.cli.completions import complete_columns
from tableverse_factory.cli.options import ReadableOut
from tableverse_factory.cli.tables import make_table, to_strict_json
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line

if TYPE_CHECKING:
    import pyarrow as pa


SHOWN_ROWS = 100
LEAST_CHARS = 12  # of a column of text, which a terminal wraps
SHOWN_COLUMNS = {
    "scenes": ("scene_id", "kind", "status", "stage", "reason", "n_objects", "usable", "quality_score"),
    "objects": ("scene_id", "object_id", "relabel_name", "mass_kg", "size_x_m", "size_y_m", "size_z_m", "contained_in"),
    "tasks": ("scene_id", "task_id", "instruction", "accepted", "refusal"),
    "trajectories": ("scene_id", "task_id", "instruction", "success", "failed_phase", "reason", "duration_s"),
}

_GAP, _UNBOUNDED = 2, 1_000_000


def query(
    out: ReadableOut,
    table: Annotated[
        Literal["scenes", "objects", "tasks", "trajectories"], typer.Option("--table", "-t", help="Which table.")
    ] = "scenes",
    where: Annotated[str | None, typer.Option("--where", "-w", metavar="CONDITION", help="As above.")] = None,
    columns: Annotated[
        str,
        typer.Option("--columns", "-c", metavar="A,B", autocompletion=complete_columns, help="Names; `all` for all."),
    ] = "",
    limit: Annotated[int | None, typer.Option("--limit", "-n", min=0, metavar="N", help="Most rows to print.")] = None,
    output: Annotated[
        Literal["table", "json", "csv"],
        typer.Option("--format", "-f", help="A table for people, wrapped on a terminal; or all rows for a script."),
    ] = "table",
    as_json: Annotated[bool, typer.Option("--json", help="The same as --format json.")] = False,
) -> None:
    """Print the rows of a table that meet a condition.

    Conditions compare columns with `= != < <= > >=`, join with `and`, `or`, `not` and parentheses, and know
    `column in ('a', 'b')`, `column is null`, `column is not null` and `column contains 'text'`.

    Example: `tableverse query out --table objects --where "mass_kg < 0.5 and relabel_name contains 'mug'"`
    """
    from tableverse_factory.dataset.dataset import open_dataset
    from tableverse_factory.dataset.query_parser import check_columns
    from tableverse_factory.dataset.query_parser import parse_filter as condition

    if as_json and output == "csv":
        raise InputError("--json and --format csv contradict each other: give one of them")
    output = "json" if as_json else output
    rows_of = open_dataset(out).table(table)
    asked = [name.strip() for name in columns.split(",") if name.strip()]
    default = SHOWN_COLUMNS[table] if output == "table" else rows_of.schema.names
    names = rows_of.schema.names if asked == ["all"] else check_columns(asked or default, rows_of.schema)
    scanner = rows_of.scanner(columns=names, filter=None if where is None else condition(where, rows_of.schema))
    if output == "table":
        _print_table(list(_iter_rows(scanner, SHOWN_ROWS + 1 if limit is None else limit)), names, limit is None)
    elif output == "json":
        _print_json(_iter_rows(scanner, limit))
    else:
        _print_csv(_iter_rows(scanner, limit), names)


def _iter_rows(scanner: "pa.dataset.Scanner", limit: int | None) -> Iterator[dict[str, Any]]:
    """Iterate over the rows in the dataset's order, without holding all of them."""
    left = math.inf if limit is None else limit
    for batch in scanner.to_batches():
        if left <= 0:
            return
        rows = batch.slice(0, int(min(left, batch.num_rows))).to_pylist()
        left -= len(rows)
        yield from rows


def _print_table(rows: Sequence[Mapping[str, Any]], names: Sequence[str], bounded: bool) -> None:
    from rich.console import Console
    from rich.text import Text

    shown = rows[:SHOWN_ROWS] if bounded else rows
    cells = [[_format_cell(row[name]) for name in names] for row in shown]
    grid, widths = make_table(), []
    for number, name in enumerate(names):
        # A figure that is wrapped is a wrong figure, and an id that is wrapped cannot be copied.
        whole = name.endswith("_id") or not any(isinstance(row[name], str | list) for row in shown)
        longest = max([len(name), *(len(row[number]) for row in cells)])
        widths.append(longest if whole else min(longest, max(len(name), LEAST_CHARS)))
        grid.add_column(name, overflow="fold", no_wrap=whole, min_width=widths[-1])
    for texts in cells:
        grid.add_row(*map(Text, texts))
    narrowest = sum(widths) + _GAP * len(widths)  # below it a column would be lost: better that the terminal wraps
    width = max(Console().width, narrowest) if sys.stdout.isatty() else Console(width=_UNBOUNDED).measure(grid).maximum
    Console(width=width, soft_wrap=True).print(grid)
    if not rows:
        print("0 rows", file=sys.stderr)
    if bounded and len(rows) > SHOWN_ROWS:
        print(f"… the first {SHOWN_ROWS} rows; give --limit, or --json or --format csv for all", file=sys.stderr)


def _format_cell(value: Any) -> str:
    """Format a value: short floats, text on one line without control characters."""
    if value is None:
        return "–"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.4g}"
    text = ", ".join(map(str, value)) if isinstance(value, list) else str(value)
    return sanitize_line(text, 10 * len(text))


def _print_json(rows: Iterable[dict[str, Any]]) -> None:
    """Print an array, a row per line, with non-ASCII characters escaped so that no text can control the terminal."""
    separator = "[\n"
    for row in rows:
        print(separator + json.dumps(to_strict_json(row)), end="")
        separator = ",\n"
    print("[]" if separator == "[\n" else "\n]")


def _print_csv(rows: Iterable[dict[str, Any]], names: Sequence[str]) -> None:
    line = io.StringIO()
    writer = csv.writer(line, lineterminator="\n")
    for values in ([*names], *([_format_csv_cell(row[name]) for name in names] for row in rows)):
        writer.writerow(values)
        print(line.getvalue(), end="")
        line.seek(0)
        line.truncate()


def _format_csv_cell(value: Any) -> Any:
    if isinstance(value, list):
        return json.dumps(value)
    return sanitize_line(value, 10 * len(value)) if isinstance(value, str) else value
