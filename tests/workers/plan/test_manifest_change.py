"""A build that goes on with another manifest is refused, and told what became of its scenes."""

import shutil
from dataclasses import replace

import pyarrow.parquet as pq
import pytest

from tableverse_factory.core.errors import BuildError
from tests.helpers.builds import Silent, request, write_manifest
from workers.run import run_build

pytestmark = pytest.mark.heavy

BEGUN = 6  # scenes of nine that are accounted for: a shard of four, and two in a journal


@pytest.fixture(scope="module")
def asked(tmp_path_factory):
    """A build that was begun."""
    folder = tmp_path_factory.mktemp("begun")
    manifest = write_manifest(folder / "m.parquet", ["fine", "empty", "sad", *["fine"] * 6])
    asked = replace(request(manifest, folder / "out"), limit=BEGUN)
    run_build(asked, Silent())
    return asked


def _refuse(asked, path, rows) -> str:
    pq.write_table(rows, path)
    with pytest.raises(BuildError, match="was begun as another build") as refused:
        run_build(replace(asked, manifest=path), Silent())
    return str(refused.value)


@pytest.mark.parametrize(
    ("rank", "columns", "words"),
    [
        (1, ("licence",), "with other values of licence, first in scene_001."),
        (2, ("uri", "licence"), "with other values of uri, licence, first in scene_002."),
        (5, ("name",), "with other values of name, first in scene_005."),
        (8, ("licence",), "with other values, such as where they lie."),  # nothing is known of it yet
    ],
)
def test_the_first_scene_that_is_another_is_named_with_what_differs(asked, tmp_path, rank, columns, words):
    rows = pq.read_table(asked.manifest)
    for name in columns:
        changed = [f"{text}?" if number in (rank, 8) else text for number, text in enumerate(rows[name].to_pylist())]
        rows = rows.set_column(rows.column_names.index(name), name, [changed])
    assert f"its manifest has the same scenes {words}" in _refuse(asked, tmp_path / "m.parquet", rows)


def test_another_order_is_told(asked, tmp_path):
    rows = pq.read_table(asked.manifest)
    words = _refuse(asked, tmp_path / "m.parquet", rows.take([*range(1, len(rows)), 0]))
    assert "its manifest has the same scenes in another order." in words


def test_a_damaged_table_hides_no_refusal(asked, tmp_path):
    asked = replace(asked, out=shutil.copytree(asked.out, tmp_path / "out"))
    (asked.out / "scenes" / "shard-00000.parquet").write_bytes(b"damaged")
    rows = pq.read_table(asked.manifest)
    licences = rows.set_column(rows.column_names.index("licence"), "licence", [["MIT"] * len(rows)])
    assert "with other values, such as where they lie." in _refuse(asked, tmp_path / "m.parquet", licences)
