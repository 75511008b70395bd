"""Tables on stdout, and strict JSON."""

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import asdict, is_dataclass
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table


def print_figures(columns: Sequence[str], rows: Iterable[Sequence[object]], title: str = "") -> None:
    """Print names and right-aligned figures at full width, also on a narrow terminal: wrapped beats cut."""
    from rich.console import Console

    table = make_table(columns[0], figures=columns[1:])
    table.columns[0].no_wrap = True
    for row in rows:
        table.add_row(*map(str, row))
    if title:
        print(title)
    width = Console(width=1000).measure(table).maximum
    Console(markup=False, highlight=False, width=max(width, Console().width)).print(table)


def make_table(*columns: str, figures: Sequence[str] = (), title: str | None = None) -> "Table":
    """Make a table of columns of text, then right-aligned columns of figures."""
    from rich.table import Table

    table = Table(*columns, box=None, pad_edge=False, title=title, title_justify="left")
    for name in figures:
        table.add_column(name, justify="right", no_wrap=True)
    return table


def print_json(value: Any, indent: int | None = 2) -> None:
    """Print a JSON document of records and values, with null for numbers that are not finite."""
    print(json.dumps(to_strict_json(value), indent=indent, allow_nan=False))


def to_strict_json(value: Any) -> Any:
    """Convert records to dictionaries, and numbers that are not finite to None."""
    if is_dataclass(value) and not isinstance(value, type):
        value = asdict(value)
    if isinstance(value, dict):
        return {key: to_strict_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [to_strict_json(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
