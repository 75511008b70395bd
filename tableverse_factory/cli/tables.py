"""Tables of figures on stdout, and strict JSON."""

import json
import math
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.table import Table


def make_figures_table(first: str, *columns: str) -> "Table":
    """Make a table with a column of names and right-aligned columns of figures, none of which is cut."""
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    table.add_column(first, no_wrap=True)
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    return table


def print_table(table: "Table", title: str = "") -> None:
    """Print a table at its full width, even if the terminal is narrower: wrapped lines read better than cut names."""
    from rich.console import Console

    if title:
        print(title)
    width = Console(width=1000).measure(table).maximum
    Console(markup=False, highlight=False, width=max(width, Console().width)).print(table)


def print_json(value: Any, indent: int = 2) -> None:
    """Print a JSON document with null for numbers that are not finite."""
    print(json.dumps(_replace_nan(value), indent=indent, allow_nan=False))


def _replace_nan(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _replace_nan(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_replace_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
