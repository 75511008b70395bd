"""Extraction of many scenes: whole folders, an index, resumption, and refusals that leave the others alone."""

import fcntl
import json
import os
import signal
import subprocess
import sys
import time

import mujoco
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.delivery.formats.extract_scenes import Appearance, extract_scenes
from tests.helpers.small_dataset import scene_files, write_small_dataset

DONE = ["a-1", "c-3", "c-4"]


@pytest.fixture
def out(tmp_path):
    return write_small_dataset(tmp_path / "out")


def read_index(dest):
    return [json.loads(line) for line in (dest / "index.jsonl").read_text().splitlines()]


def read_tree(dest):
    return {str(path.relative_to(dest)): path.read_bytes() for path in dest.rglob("*") if path.is_file()}


@pytest.mark.heavy
def test_each_finished_scene_has_a_folder_that_mujoco_loads_from_any_number_of_processes(out, tmp_path):
    dest = tmp_path / "scenes"
    summary = extract_scenes(str(out), dest)
    assert (summary.written, summary.kept, summary.refused) == (3, 0, ())
    assert [row["scene_id"] for row in read_index(dest)] == DONE
    for row in read_index(dest):
        mujoco.MjModel.from_xml_path(str(dest / row["path"]))
        assert row["tasks"] == [{"task_id": "task_000", "instruction": "Put it."}]
        assert row["split"] in ("train", "validation", "test")
        for name, data in scene_files(row["scene_id"]):
            assert (dest / row["scene_id"] / name).read_bytes() == data
    assert sorted(path.name for path in dest.iterdir()) == [*DONE, "extract.json", "index.jsonl"]
    extract_scenes(str(out), tmp_path / "two", jobs=2)
    assert read_tree(tmp_path / "two") == read_tree(dest)


def test_conditions_select_and_add(out, tmp_path):
    dest = tmp_path / "scenes"
    assert extract_scenes(str(out), dest, where="scene_id = 'c-3'").written == 1
    assert [row["scene_id"] for row in read_index(dest)] == ["c-3"]
    before = (dest / "c-3" / "scene.xml").stat().st_mtime_ns
    summary = extract_scenes(str(out), dest, where="n_objects >= 1")
    assert (summary.written, summary.kept) == (2, 1)
    assert (dest / "c-3" / "scene.xml").stat().st_mtime_ns == before
    assert [row["scene_id"] for row in read_index(dest)] == DONE
    with pytest.raises(InputError, match="no finished scene meets 'n_objects = 99'"):
        extract_scenes(str(out), tmp_path / "none", where="n_objects = 99")
    assert not (tmp_path / "none").exists()


def test_what_a_kill_left_is_made_again_and_no_folder_is_half(out, tmp_path):
    dest = tmp_path / "scenes"
    extract_scenes(str(out), dest, where="scene_id = 'a-1'")
    (dest / ".partial" / "c-3").mkdir(parents=True)
    (dest / ".partial" / "c-3" / "scene.xml").write_text("<mujoco>")
    (dest / "index.jsonl").unlink()
    assert extract_scenes(str(out), dest).written == 2
    assert not (dest / ".partial").exists()
    extract_scenes(str(out), tmp_path / "whole")
    assert read_tree(dest) == read_tree(tmp_path / "whole")


def test_a_folder_of_something_else_is_refused(out, tmp_path):
    dest = tmp_path / "scenes"
    extract_scenes(str(out), dest)
    (tmp_path / "other").mkdir()
    other = write_small_dataset(tmp_path / "other" / "out")
    (other / "run.json").write_text('{"config": 1}')
    for change, match in (
        ({"file_format": "glb"}, "in another format"),
        ({"appearance": Appearance(lights=1)}, "that look otherwise"),
        ({"out": str(other)}, "of another dataset"),
    ):
        with pytest.raises(InputError, match=match):
            extract_scenes(**{"out": str(out), "dest": dest, **change})
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("dear")
    with pytest.raises(InputError, match="give a new or an empty folder"):
        extract_scenes(str(out), tmp_path / "mine")
    with (dest / "extract.json").open("rb") as held:
        fcntl.flock(held, fcntl.LOCK_EX)
        with pytest.raises(InputError, match="another extraction writes there"):
            extract_scenes(str(out), dest)


def test_one_that_cannot_be_written_is_named_and_the_others_are_written(out, tmp_path):
    tar = next((out / "mjcf").glob("*0.tar"))
    data = tar.read_bytes()
    tar.write_bytes(data.replace(b'<body name="obj_000"', b'<body name="../../x"'))
    summary = extract_scenes(str(out), tmp_path / "scenes", "urdf")
    assert summary.written == 2
    assert [(name, why.partition(":")[0]) for name, why in summary.refused] == [
        ("a-1", "a body of the scene cannot be a file")
    ]
    assert [row["scene_id"] for row in read_index(tmp_path / "scenes")] == ["c-3", "c-4"]
    assert not (tmp_path / "x").exists()


def test_a_format_whose_package_is_missing_is_refused_before_any_work(out, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(InputError, match=r"tableverse-factory\[usd\]"):
        extract_scenes(str(out), tmp_path / "new", "usd")
    assert not (tmp_path / "new").exists()


def test_an_id_that_leaves_the_folder_is_refused(out, tmp_path):
    path = next((out / "scenes").glob("*0.parquet"))
    table = pq.read_table(path)
    ids = pc.replace_substring(table["scene_id"], "a-1", "../a")
    pq.write_table(table.set_column(0, "scene_id", pa.chunked_array(ids)), path)
    assert "../a" in open_dataset(str(out)).scenes.to_table()["scene_id"].to_pylist()
    with pytest.raises(InputError, match="cannot be a folder"):
        extract_scenes(str(out), tmp_path / "scenes")


@pytest.mark.slow  # builds are killed in the fast run
@pytest.mark.heavy
def test_killed_and_run_again_it_has_every_scene_once(out, tmp_path):
    dest = tmp_path / "scenes"
    command = [sys.executable, "-c", "from tableverse_factory.cli.main import main; main()", "extract", str(out)]
    first = subprocess.Popen([*command, str(dest)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until = time.monotonic() + 60
    while not any(dest.glob("[ac]-*")) and time.monotonic() < until and first.poll() is None:
        time.sleep(0.005)
    os.kill(first.pid, signal.SIGKILL)
    first.wait()
    while time.monotonic() < until:  # its processes end with it
        again = subprocess.run([*command, str(dest)], capture_output=True, text=True, check=False)
        if "another extraction" not in again.stderr:
            break
    assert again.returncode == 0, again.stderr
    extract_scenes(str(out), tmp_path / "whole")
    assert read_tree(dest) == read_tree(tmp_path / "whole")
