"""The page on formats names every column that a consumer will find."""

import pytest

from schemas.arrow import TABLES
from tests.helpers.paths import ROOT

PAGE = ROOT / "docs" / "formats.md"


@pytest.mark.parametrize("table", TABLES)
def test_every_column_is_documented(table):
    text = PAGE.read_text()
    missing = [name for name in TABLES[table].names if f"`{name}`" not in text]
    assert not missing
