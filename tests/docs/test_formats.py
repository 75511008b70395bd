"""The page on formats names every column that a consumer will find."""

from pathlib import Path

import pytest

from schemas.arrow import TABLES

PAGE = Path(__file__).resolve().parents[2] / "docs" / "formats.md"


@pytest.mark.parametrize("table", TABLES)
def test_every_column_is_documented(table):
    text = PAGE.read_text()
    missing = [name for name in TABLES[table].names if f"`{name}`" not in text]
    assert not missing
