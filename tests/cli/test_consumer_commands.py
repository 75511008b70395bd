"""query, extract, manifest, config: what a script reads is sound, what a person reads cannot drive the terminal."""

import csv
import io
import json
import re
import sys

import mujoco
import pyarrow.parquet as pq
import pytest

from schemas.config import Config
from schemas.tables import OBJECTS
from tableverse_factory.core.config import fingerprint_config, load_config
from tests.helpers.captures_on_disk import write_capture, write_picture
from tests.helpers.small_dataset import LONG_DETAIL, scene_files, write_small_dataset
from tests.helpers.terminal import watch


@pytest.fixture
def out(tmp_path):
    return write_small_dataset(tmp_path / "out")


def test_query_prints_a_table(tableverse, out):
    answer = tableverse(
        "query", out, "--table", "objects", "--where", "mass_kg < 0.5", "--columns", "scene_id,label,mass_kg"
    )
    assert answer.code == 0
    assert [line.split() for line in answer.out.splitlines()] == [
        ["scene_id", "label", "mass_kg"],
        *([scene, "red", "mug", "0.31"] for scene in ("a-1", "c-3", "c-4")),
    ]


def test_query_prints_json_and_csv_with_every_column(tableverse, out):
    rows = json.loads(tableverse("query", out, "-t", "objects", "--json").out)
    assert len(rows) == 9
    assert list(rows[0]) == OBJECTS.names
    assert rows[0]["mass_kg"] == 0.31
    assert rows[2]["mass_kg"] is None
    table = list(csv.DictReader(io.StringIO(tableverse("query", out, "-t", "objects", "-f", "csv").out)))
    assert [row["label"] for row in table[:2]] == ["red mug", "bowl"]
    assert table[2]["mass_kg"] == ""
    assert json.loads(tableverse("query", out, "--where", "n_objects = 99", "--json").out) == []


def test_json_that_is_csv_too_is_refused(tableverse, out):
    answer = tableverse("query", out, "--json", "-f", "csv")
    assert (answer.code, answer.out) == (1, "")
    assert "--json and --format csv contradict each other" in answer.err


@pytest.mark.parametrize("output", ["table", "json", "csv"])
def test_texts_cannot_drive_the_terminal(tableverse, out, output):
    for table in ("objects", "scenes"):
        answer = tableverse("query", out, "-t", table, "-f", output, "-c", "all")
        assert all(c.isprintable() or c == "\n" for c in answer.out)
        assert "x1b" in answer.out or "u001b" in answer.out, "what was there is shown, made harmless"


def test_query_shows_the_names_that_tasks_use_and_says_where_nothing_is(tableverse, out):
    assert tableverse("query", out, "-t", "objects").out.split()[:3] == ["scene_id", "object_id", "relabel_name"]
    answer = tableverse("query", out, "--where", "n_objects = 99")
    assert (answer.code, answer.err) == (0, "0 rows\n")
    assert "0 rows" not in answer.out


@pytest.mark.parametrize("condition", ["", " "])
def test_an_empty_condition_is_not_taken_for_none(tableverse, out, tmp_path, condition):
    for command in (("query", out), ("extract", out, tmp_path / "dest")):
        answer = tableverse(*command, "--where", condition)
        assert (answer.code, answer.out) == (1, "")
        assert "the condition is empty" in answer.err


@pytest.mark.heavy
def test_query_takes_no_more_than_asked(tableverse, out, monkeypatch):
    assert len(json.loads(tableverse("query", out, "--limit", "2", "--json").out)) == 2
    assert len(tableverse("query", out, "--limit", "2").out.splitlines()) == 3
    monkeypatch.setattr("tableverse_factory.cli.query.SHOWN_ROWS", 3)
    answer = tableverse("query", out)
    assert len(answer.out.splitlines()) == 4
    assert "the first 3 rows" in answer.err
    assert tableverse("query", out, "--limit", "5").err == ""
    assert json.loads(tableverse("query", out, "--limit", "0", "--json").out) == []


def test_a_reason_can_be_read_to_its_end(tableverse, out):
    """Whole in a pipe, wrapped on a terminal, where ids and figures stay on one line."""
    columns = ("-c", "scene_id,attempts,detail", "--where", "status = 'failed'")
    assert LONG_DETAIL in tableverse("query", out, *columns).out
    command = [
        sys.executable,
        "-c",
        "from tableverse_factory.cli.main import main; main()",
        "query",
        str(out),
        *columns,
    ]
    seen = watch(command, size=(60, 30))
    assert seen.code == 0
    assert re.match(r"d-5 +1 +signal 11", seen.screen[1])
    words = " ".join(seen.screen[1:]).split()
    assert words[2:] == LONG_DETAIL.split()
    assert max(map(len, seen.screen)) <= 60


def test_query_points_at_the_error(tableverse, out):
    answer = tableverse("query", out, "-t", "objects", "--where", "label = 'a' and mas_kg < 1")
    assert answer.code == 1
    first, line, carets, _ = answer.err.splitlines()
    assert first == "error: no column 'mas_kg'; did you mean mass_kg?"
    assert line[carets.index("^") :][: carets.count("^")] == "mas_kg"
    assert "did you mean label" in tableverse("query", out, "-t", "objects", "-c", "lable").err
    assert tableverse("query", out, "-t", "nosuch").code == 2


def test_extract_gives_a_scene_that_mujoco_loads(tableverse, out, tmp_path):
    answer = tableverse("extract", out, tmp_path / "scene", "--scene", "c-3")
    assert answer.code == 0
    mujoco.MjModel.from_xml_path(str(tmp_path / "scene" / "scene.xml"))
    for name, data in scene_files("c-3"):
        assert (tmp_path / "scene" / name).read_bytes() == data
    assert tableverse("extract", out, tmp_path / "scene", "--scene", "c-3").code == 1
    assert "not_at_rest" in tableverse("extract", out, tmp_path / "other", "--scene", "b-2").err
    assert not (tmp_path / "other").exists()


def test_extract_writes_many_scenes_and_fails_where_one_is_missing(tableverse, out, tmp_path):
    answer = tableverse("extract", out, tmp_path / "scenes", "--where", "n_objects = 1", "--jobs", "1")
    assert (answer.code, answer.out) == (0, f"3 scenes written to {tmp_path / 'scenes'}\n")
    again = tableverse("extract", out, tmp_path / "scenes", "--jobs", "1")
    assert again.out == f"0 scenes written to {tmp_path / 'scenes'}, 3 were there\n"
    assert tableverse("extract", out, tmp_path / "x", "--scene", "c-3", "--where", "n_objects = 1").code == 2
    tar = next((out / "mjcf").glob("*0.tar"))
    tar.write_bytes(tar.read_bytes().replace(b'<body name="obj_000"', b'<body name="../../x"'))
    answer = tableverse("extract", out, tmp_path / "urdf", "--format", "urdf", "--jobs", "1")
    assert answer.code == 1
    assert "  not a-1: a body of the scene cannot be a file" in answer.out


def test_manifest_counts_what_it_found(tableverse, tmp_path):
    write_capture(tmp_path / "in" / "a", 1)
    write_capture(tmp_path / "in" / "b", 1)
    write_picture(tmp_path / "in" / "photo.png", 2)
    (tmp_path / "in" / "bad\x1b[2J.png").write_bytes(b"")
    answer = tableverse("manifest", tmp_path / "in", "--out", tmp_path / "m.parquet")
    assert answer.code == 0
    assert pq.read_metadata(tmp_path / "m.parquet").num_rows == 4
    assert all(c.isprintable() or c == "\n" for c in answer.out)
    assert "4 rows in" in answer.out
    assert "without a licence: 2; " in answer.out
    counted = json.loads(tableverse("manifest", tmp_path / "in", "--out", tmp_path / "m.parquet", "--json").out)
    assert counted["counts"] == {
        "capture": {"accepted": 1, "duplicate_of": 1},
        "image": {"accepted": 1, "unreadable_color": 1},
    }


def test_manifest_keeps_to_the_bounds_of_the_configuration(tableverse, tmp_path):
    write_picture(tmp_path / "in" / "photo.png", 2)
    options = ("--out", tmp_path / "m.parquet", "--set", "observe.max_pixels=10", "--json")
    answer = tableverse("manifest", tmp_path / "in", *options)
    assert json.loads(answer.out)["counts"] == {"image": {"picture_too_large": 1}}
    assert answer.code == 1, "a script must not go on to build nothing"
    assert "every row is rejected" in answer.err
    assert pq.read_metadata(tmp_path / "m.parquet").num_rows == 1


def test_config_prints_a_file_that_reads_back(tableverse, tmp_path):
    answer = tableverse("config", "--set", "run.seed=5")
    (tmp_path / "c.yaml").write_text(answer.out)
    assert load_config(tmp_path / "c.yaml") == load_config(None, ["run.seed=5"])
    found = json.loads(tableverse("config", "--json").out)
    assert found["fingerprint"] == fingerprint_config(Config())
    assert Config.model_validate(found["config"]) == Config()


@pytest.mark.parametrize("command", ["status", "verify", "query"])
def test_a_damaged_parquet_file_is_one_line(tableverse, out, command):
    path = next((out / "scenes").iterdir())
    path.write_bytes(path.read_bytes()[:500])
    answer = tableverse(command, out)
    assert answer.code == 1
    assert answer.err.startswith("error: ")
    assert "damaged" in answer.err
    assert len(answer.err.splitlines()) <= 2
