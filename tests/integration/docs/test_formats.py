"""The page on formats names every column, and its example rows fit the tables."""

import json
import re

import pyarrow as pa
import pytest

from schemas.tables import MANIFEST, TABLES, TIMINGS
from tests.helpers.paths import ROOT

PAGE = ROOT / "docs" / "formats.md"
EXAMPLES = {"manifest": MANIFEST, **TABLES, "timings": TIMINGS}


@pytest.mark.parametrize("table", TABLES)
def test_every_column_is_documented(table: str) -> None:
    text = PAGE.read_text()
    assert not [name for name in TABLES[table].names if f"`{name}`" not in text]


@pytest.mark.parametrize("table", EXAMPLES)
def test_every_table_has_an_example_row_that_fits_it(table: str) -> None:
    rows = [json.loads(block) for block in re.findall(r"```json\n(.*?)```", PAGE.read_text(), re.DOTALL)]
    schema = EXAMPLES[table]
    needed = {field.name for field in schema if not field.nullable}
    (row,) = [row for row in rows if set(row) <= set(schema.names) and needed <= set(row) and is_of(table, row)]
    assert pa.Table.from_pylist([row], schema=schema).num_rows == 1


def is_of(table: str, row: dict[str, object]) -> bool:
    """Whether a row has the column that no other table has."""
    own = {"manifest": "rejected", "scenes": "status", "objects": "object_id", "tasks": "accepted"}
    return {**own, "trajectories": "success", "timings": "cpu_s"}[table] in row
