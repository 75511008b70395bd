"""Parquet written in parts is the Parquet written at once."""

import pytest

from schemas.tables import MANIFEST
from tableverse_factory.core.storage.parquet import ROW_GROUP, build_table, encode_parquet, encode_rows


@pytest.mark.parametrize("n_rows", [0, 1, ROW_GROUP, ROW_GROUP + 1, 2 * ROW_GROUP + 5])
def test_rows_give_the_bytes_of_their_table(n_rows):
    rows = [{"scene_id": f"scene-{i * 7919 % 10007}", "kind": "capture", "uri": f"/data/{i}"} for i in range(n_rows)]
    assert encode_rows(iter(rows), MANIFEST) == encode_parquet(build_table(rows, MANIFEST))
