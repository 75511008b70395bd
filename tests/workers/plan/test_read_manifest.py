"""The reader of manifests: pydantic decides about every row, however the columns are typed, and every id is unique."""

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from schemas.manifest import ImageRow, SceneKind
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset import image_rows
from workers.plan import read_manifest as module
from workers.plan.read_manifest import read_manifest

CAMERA = '{"kind":"camera_height","length_m":0.6}'
TEXTS = {
    "scene_id": ["a", "b", "c.d-e_f", "", ".a", "a..b", "a" * 80, "a" * 81, "ä", "a\n", "duplicate-0", "invalid-0"],
    "kind": ["image", "capture", "layout", "Image", "picture", ""],
    "uri": ["/x", "", "u" * 4096, "u" * 4097, "ü" * 4096],
    "name": ["", "n", "ñ" * 512, "ñ" * 513, "\x00"],
    "content_sha256": ["", "0" * 64, "0" * 63, "0" * 64 + "\n", "G" * 64],
    "url": ["", "https://example.org/a", "u" * 4097],
    "source": ["", "s" * 2048, "s" * 2049],
    "licence": ["", "CC0-1.0", "l" * 513],
    "known_length": ["", CAMERA, CAMERA.replace("0.6", "6e-1"), CAMERA.replace("0.6", "NaN"), "{}", "k" * 1001],
    "rejected": ["", "too_dark", "Too dark", "r" * 81, "\n"],
    "rejected_detail": ["", "d" * 2000, "d" * 2001],
}
GOOD = {"scene_id": "a", "kind": "capture", "uri": "/x"}


def cells(name):
    """Values of a column: mostly the first ones, which are valid."""
    return st.one_of(st.sampled_from(TEXTS[name][:2]), st.sampled_from([None, *TEXTS[name]]))


ROWS = st.lists(st.fixed_dictionaries({name: cells(name) for name in TEXTS}), max_size=12)
TYPES = st.sampled_from([pa.string(), pa.large_string(), pa.string_view(), pa.dictionary(pa.int8(), pa.string())])


def write(path, table):
    pq.write_table(table, path)
    return path


def judge(record):
    """The row as pydantic takes it; None if it does not."""
    try:
        return ImageRow.model_validate({name: value for name, value in record.items() if value is not None})
    except ValidationError:
        return None


@given(ROWS, st.lists(TYPES, min_size=len(TEXTS), max_size=len(TEXTS)), st.integers(1, 5))
def test_pydantic_decides_about_every_row(tmp_path_factory, records, types, batch_rows):
    columns = {
        name: pa.array([record[name] for record in records], pa.string()).cast(kind)
        for name, kind in zip(TEXTS, types, strict=True)
    }
    path = write(tmp_path_factory.mktemp("hostile") / "m.parquet", pa.table(columns))
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(module, "BATCH_ROWS", batch_rows)
        rows = read_manifest(path)
    assert len(rows) == len(records)
    assert len({row.scene_id for row in rows}) == len(rows), "ids are unique"
    assert list(rows) == [rows[rank] for rank in range(len(rows))]
    known: dict[str, int] = {}
    for number, (row, record) in enumerate(zip(rows, records, strict=True)):
        expected = judge(record)
        if expected is None:
            assert (row.scene_id[:8], row.rejected) == ("invalid-", "invalid_manifest_row")
            assert row.rejected_detail.startswith(f"row {number}: ")
        elif expected.scene_id in known:
            assert (row.scene_id[:10], row.rejected) == ("duplicate-", "duplicate_scene_id")
            detail = f"row {number} repeats the scene_id {expected.scene_id} of row {known[expected.scene_id]}"
            assert row == expected.model_copy(
                update={"scene_id": row.scene_id, "rejected": row.rejected, "rejected_detail": detail}
            )
        else:
            assert row == expected
        known.setdefault(row.scene_id, number)


@given(ROWS)
def test_rows_in_columns_are_the_rows(records):
    rows = [row for row in map(judge, records) if row is not None]
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(image_rows, "BATCH_ROWS", 3)
        columns = image_rows.ImageRows.from_rows(rows)
    assert list(columns) == rows
    assert list(columns[1:3]) == rows[1:3]
    assert list(columns[::-2]) == rows[::-2]
    assert list(columns.column("name")) == [row.name for row in rows]


@pytest.mark.parametrize("name", ["scene_id", "kind", "uri", "licence"])
def test_columns_that_hold_no_text_are_judged_row_by_row(tmp_path, name):
    good = {"scene_id": ["a", "b"], "kind": ["image", "image"], "uri": ["/x", "/y"], "licence": ["", "CC0-1.0"]}
    path = tmp_path / "m.parquet"
    for values in ([1, None], [[1], [2]], [{"x": 1}, None], [1.5, float("nan")]):
        rows = read_manifest(write(path, pa.table({**good, name: values})))
        invalid = [value is not None or name != "licence" for value in values]
        assert [row.rejected == "invalid_manifest_row" for row in rows] == invalid
        assert len({row.scene_id for row in rows}) == 2


@pytest.mark.parametrize("name", ["scene_id", "kind", "uri", "name"])
@pytest.mark.parametrize(
    ("kind", "value"),
    [
        (pa.timestamp("ns"), 1_700_000_000_123_456_789),
        (pa.timestamp("us"), 2**62),
        (pa.timestamp("us", "Nowhere/City"), 0),
        (pa.time64("ns"), 1),
        (pa.date32(), 2**30),
        (pa.list_(pa.timestamp("ns")), [1]),
    ],
    ids=str,
)
def test_times_that_python_cannot_hold_are_no_text_and_elsewhere_nobody_minds(tmp_path, name, kind, value):
    good = {"scene_id": ["a", "b"], "kind": ["image", "image"], "uri": ["/x", "/y"]}
    times = pa.array([value, None], kind)
    rows = read_manifest(write(tmp_path / "m.parquet", pa.table({**good, "taken_at": times})))
    assert [row.rejected for row in rows] == ["", ""]
    rows = read_manifest(write(tmp_path / "m.parquet", pa.table({**good, name: times})))
    assert [row.rejected for row in rows] == ["invalid_manifest_row", "" if name == "name" else "invalid_manifest_row"]
    assert rows[0].rejected_detail.startswith(f"row 0: {name}: ")


@pytest.mark.parametrize(
    ("column", "value", "detail"),
    [
        ("uri", [1, 2], "uri: give a text, not [1, 2]"),
        ("name", 2.5, "name: give a text, not 2.5"),
        ("kind", "photo\x1b[2J", r"kind: give 'image', 'capture', 'layout' or 'cousin', not 'photo\x1b[2J'"),
        ("scene_id", "a/b", "scene_id: id 'a/b' is not usable: give 1 to 80 letters, digits"),
        ("content_sha256", "xyz", "content_sha256: give a text that matches ^([0-9a-f]{64})?$, not 'xyz'"),
        ("uri", ["y" * 10**5] * 50, "uri: give a text, not ['yyyy"),
    ],
)
def test_the_detail_names_the_value_and_what_would_be_right(tmp_path, column, value, detail):
    (row,) = read_manifest(write(tmp_path / "m.parquet", pa.Table.from_pylist([{**GOOD, column: value}])))
    assert row.rejected == "invalid_manifest_row"
    assert row.rejected_detail.startswith(f"row 0: {detail}")
    assert row.rejected_detail.isprintable()
    assert len(row.rejected_detail) < 250


def test_ids_of_rejected_rows_stay_what_they_were(tmp_path):
    """They are in the datasets that were built: another id would be another scene."""
    records = [GOOD, {**GOOD, "scene_id": "a/b"}, GOOD, {**GOOD, "kind": "photo", "uri": None}]
    rows = read_manifest(write(tmp_path / "m.parquet", pa.Table.from_pylist(records)))
    assert [row.scene_id for row in rows] == [
        "a",
        "invalid-1bcd2fdb4f1c3e38",
        "duplicate-f2b2fb62577495f1",
        "invalid-8c095d82c823ea2e",
    ]
    assert rows[3].kind is SceneKind.IMAGE


def test_an_id_that_foresees_the_one_of_a_duplicate_is_no_way_to_repeat_it(tmp_path):
    (duplicate,) = read_manifest(write(tmp_path / "a.parquet", pa.Table.from_pylist([GOOD] * 3)))[2:]
    records = [{**GOOD, "scene_id": duplicate.scene_id}, GOOD, GOOD]
    rows = read_manifest(write(tmp_path / "b.parquet", pa.Table.from_pylist(records)))
    assert len({row.scene_id for row in rows}) == 3


def test_only_columns_of_a_row_are_read_and_damage_is_said(tmp_path):
    path = tmp_path / "m.parquet"
    write(path, pa.Table.from_pylist([{**GOOD, "pixels": b"x" * 1000, "other": 1}]))
    assert list(read_manifest(path)) == [ImageRow(**GOOD)]
    torn = pa.StringArray.from_buffers(1, pa.py_buffer(b"\0\0\0\0\1\0\0\0"), pa.py_buffer(b"\xff"))
    write(path, pa.table({"scene_id": ["a"], "kind": ["image"], "uri": torn}))
    with pytest.raises(InputError, match=r"m\.parquet is no Parquet file: .*UTF8"):
        read_manifest(path)
    path.write_bytes(path.read_bytes()[:-9])
    with pytest.raises(InputError, match=r"m\.parquet is no Parquet file"):
        read_manifest(path)
    write(path, pa.table({"scene_id": ["a"], "other": [1]}))
    with pytest.raises(InputError, match="lacks the columns kind, uri: it has scene_id, other"):
        read_manifest(path)
    write(path, pa.table([["a"], ["image"], ["b"], ["c"]], names=["scene_id", "kind", "uri", "uri"]))
    with pytest.raises(InputError, match="has several columns uri: give one of each"):
        read_manifest(path)
