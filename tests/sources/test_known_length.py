"""Known lengths from `source.json`, a list and the option: in the row, or refused with the value and the place."""

import json

import pytest

from schemas.config import ObserveConfig
from schemas.known_length import parse_known_length
from tableverse_factory.core.errors import InputError
from tableverse_factory.sources.known_length import check_pixels, read_known_length, rescale_pixels
from tableverse_factory.sources.manifest import make_manifest
from tableverse_factory.sources.urls.lists import read_list
from tests.helpers.captures_on_disk import write_capture, write_layout, write_picture

BOUNDS = ObserveConfig()
CAMERA = {"kind": "camera_height", "length_m": 0.6}
EDGE = {"kind": "distance", "length_m": 0.2, "pixels": [[3, 4], [25, 20]]}


def rows_of(folder, **options):
    return make_manifest([str(folder)], BOUNDS, **options).rows


def with_source(folder, value, name="source.json"):
    (folder / name).write_text(json.dumps(value))
    return folder


def test_it_is_read_beside_a_picture_and_in_a_capture(tmp_path):
    write_picture(tmp_path / "p" / "a.png", 1)
    write_picture(tmp_path / "p" / "b.png", 2)
    with_source(tmp_path / "p", {"licence": "CC0-1.0", "known_length": CAMERA})
    with_source(tmp_path / "p", {"known_length": EDGE}, "b.source.json")
    with_source(write_capture(tmp_path / "q", 3), {"known_length": EDGE})
    rows = rows_of(tmp_path)
    assert [row.rejected for row in rows] == [""] * 3
    assert [json.loads(row.known_length) for row in rows] == [CAMERA, EDGE, EDGE]
    assert rows[0].licence == "CC0-1.0"


def test_it_counts_for_the_id_and_its_spelling_does_not(tmp_path):
    write_picture(tmp_path / "a.png", 1)
    plain = rows_of(tmp_path)[0].scene_id
    spellings = (EDGE, {**EDGE, "pixels": [[3.0, 4], [25, 20.0]]}, {**EDGE, "length_m": 0.3})
    ids = [rows_of(with_source(tmp_path, {"known_length": value}))[0].scene_id for value in spellings]
    assert ids[0] == ids[1] != ids[2]
    assert plain not in ids
    assert rows_of(with_source(tmp_path, {"licence": "MIT"}))[0].scene_id == plain


def test_the_option_is_for_bare_pictures_that_have_none(tmp_path):
    write_picture(tmp_path / "a.png", 1)
    write_picture(tmp_path / "b" / "b.png", 2)
    write_capture(tmp_path / "c", 3)
    write_layout(tmp_path / "d" / "d.json")
    with_source(tmp_path / "b", {"known_length": EDGE})
    rows = rows_of(tmp_path, known_length=parse_known_length(json.dumps(CAMERA)))
    assert [row.known_length and json.loads(row.known_length) for row in rows] == [CAMERA, EDGE, "", ""]


@pytest.mark.parametrize(
    ("value", "told"),
    [
        ({**EDGE, "length_m": 1e9}, "source.json: known_length: length_m: give at most 10, not"),
        ({**EDGE, "length_m": float("nan")}, "length_m: give a finite number, not nan"),
        ({**EDGE, "pixels": [[3, 4], [32, 20]]}, "the pixel (32, 20) lies outside: the upright picture has 32 x 24"),
        ({"kind": "a4\n\x1b[31m", "pixels": []}, "give one of 'distance', 'a4'"),
        ([], "give keys and values"),
        (0.3, "give keys and values, not 0.3"),
        ("0.3 m", "JSON"),
        ({"kind": "a4", "pixels": [[0, 0]] * 4000}, "at most 1000"),
    ],
    ids=str,
)
@pytest.mark.parametrize("kind", ["picture", "capture"])
def test_what_cannot_be_is_a_row_with_its_reason(tmp_path, value, told, kind):
    if kind == "picture":
        write_picture(tmp_path / "a" / "a.png", 1)
    else:
        write_capture(tmp_path / "a", 1)
    with_source(tmp_path / "a", {"licence": "MIT", "known_length": value})
    (row,) = rows_of(tmp_path)
    assert row.rejected == "bad_known_length"
    assert told in row.rejected_detail
    assert row.rejected_detail.isprintable()


def test_a_layout_has_no_use_for_one(tmp_path):
    write_layout(tmp_path / "a.json")
    (row,) = rows_of(with_source(tmp_path, {"known_length": CAMERA}))
    assert row.rejected == "bad_known_length"
    assert "a layout is given in metres" in row.rejected_detail


def test_a_list_has_a_column_for_it(tmp_path):
    cell = json.dumps(EDGE).replace('"', '""')
    (tmp_path / "a.csv").write_text(f'url,known_length\nhttps://example.org/a.jpg,"{cell}"\n')
    (tmp_path / "b.jsonl").write_text(json.dumps({"url": "https://example.org/a.jpg", "known_length": EDGE}) + "\n")
    for name in ("a.csv", "b.jsonl"):
        found = read_list(str(tmp_path / name))
        assert found.ignored == ()
        assert json.loads(found.rows[0].known_length) == EDGE
    (tmp_path / "a.csv").write_text(f"url,known_length\nhttps://example.org/a.jpg,{'k' * 1001}\n")
    (row,) = read_list(str(tmp_path / "a.csv")).rows
    assert row.problem is not None
    assert row.problem[0] == "bad_known_length"


def test_the_command_takes_one_and_names_what_is_wrong(tmp_path, run):
    write_picture(tmp_path / "in" / "a.png", 1)
    line = ("manifest", tmp_path / "in", "--out", tmp_path / "m.parquet", "--known-length")
    assert run(*line, json.dumps(CAMERA))[0] == 0
    code, _, told = run(*line, json.dumps({**CAMERA, "length_m": -1}))
    assert code == 1
    assert "--known-length: length_m: give at least 0.05, not -1" in " ".join(told.split())


@pytest.mark.parametrize("pixel", [(31.6, 0.0), (0.0, 23.6), (1000.0, 1000.0)])
def test_pixels_lie_within_the_picture(pixel):
    known = parse_known_length(json.dumps({"kind": "height", "length_m": 0.1, "pixels": [pixel]}))
    with pytest.raises(InputError) as refused:
        check_pixels(known, 32, 24)
    assert refused.value.reason == "bad_known_length"
    check_pixels(known, 2000, 2000)


def test_pixels_follow_the_picture_to_another_size():
    """A block of pixels becomes one pixel: its middle is the middle of that."""
    known = read_known_length(json.dumps({"kind": "height", "length_m": 0.1, "pixels": [[5.5, 1.5]]}), "here")
    assert rescale_pixels(known, (400, 400), (100, 100)).pixels == ((1.0, 0.0),)
    assert rescale_pixels(known, (400, 400), (400, 400)) is known
