"""`build`, `status` and `failures` as a user and a script see them."""

import json
import os
import platform
import re
import socket

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.helpers.builds import build as build_tiny
from tests.helpers.builds import write_manifest
from workers.state.lock import create_writer_lock

NAMES = ["fine", "empty", "sad", "fell", "fine"]


@pytest.fixture
def out(tmp_path):
    build_tiny(write_manifest(tmp_path / "images.parquet", NAMES), tmp_path / "out")
    return tmp_path / "out"


def test_status_for_people_and_for_scripts(run, out):
    code, text, _ = run("status", out)
    assert code == 0
    assert "5 scenes: 2 done, 2 dropped, 1 failed, 0 remaining; 2 of 2 shards committed" in " ".join(text.split())
    assert re.search(r"failed +cut +GeometryError +1", text)
    assert "not_at_rest: the objects did not come to rest" in text.splitlines()
    code, text, _ = run("status", out, "--json")
    found = json.loads(text)
    assert (found["done"], found["dropped"], found["failed"], found["remaining"]) == (2, 2, 1, 0)
    assert [stage["stage"] for stage in found["stages"]] == ["look", "cut", "fall", "pack"]
    assert {row["why"]: row["scenes"] for row in found["funnel"]} == {
        "nothing_there": 1, "not_at_rest": 1, "GeometryError": 1,
    }  # fmt: skip


def test_status_names_the_build_that_runs_and_gives_no_advice_for_a_second_one(run, out):
    with create_writer_lock(out / ".work" / "lock"):
        code, text, _ = run("status", out)
    assert code == 0
    assert f"being written by process {os.getpid()} on {platform.node()}" in text.splitlines()
    assert "wait for it" not in text


@pytest.mark.parametrize("option", [(), ("--watch",), ("--json",)])
def test_status_of_a_build_that_has_just_begun_says_so(run, tmp_path, option):
    with create_writer_lock(tmp_path / "out" / ".work" / "lock"):
        code, _, errors = run("status", tmp_path / "out", *option)
    assert code == 1
    assert f"a build begins there just now, by process {os.getpid()}" in errors


def test_failures_say_why_and_retry_puts_exactly_those_back(run, out):
    code, text, _ = run("failures", out)
    assert code == 0
    assert "scene_002: 3 vertices cannot close a surface" in " ".join(text.split())
    assert "not_at_rest" not in text
    listed = json.loads(run("failures", out, "--json", "--reason", "not_at_rest")[1])
    assert [row["scene_id"] for row in listed] == ["scene_003"]
    assert "not_at_rest: the objects did not come" in run("failures", out, "--reason", "not_at_rest")[1]
    assert json.loads(run("failures", out, "--json", "--stage", "look")[1])[0]["why"] == "nothing_there"
    assert json.loads(run("failures", out, "--json", "--stage", "pack")[1]) == []

    assert "1 scene in 1 shard put back: run the same `tableverse build`" in run("failures", out, "--retry")[1]
    assert json.loads(run("status", out, "--json")[1])["remaining"] == 1
    build_tiny(out.parent / "images.parquet", out)
    assert json.loads(run("status", out, "--json")[1])["failed"] == 1


def test_a_refused_build_leaves_nothing_that_refuses_the_next(run, tmp_path):
    """The cause may lie in the manifest, as where the cluster does not see its inputs: it is another one then."""
    rows = [{"scene_id": name, "kind": "capture", "uri": "/x", "rejected": "unreadable_color"} for name in "ab"]
    out, manifest = tmp_path / "out", tmp_path / "images.parquet"
    pq.write_table(pa.Table.from_pylist(rows), manifest)
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        code, _, errors = run("build", manifest, out, "--address", f"127.0.0.1:{closed.getsockname()[1]}")
    assert (code, "cannot be reached" in errors) == (1, True)
    assert list(out.iterdir()) == []
    pq.write_table(pa.Table.from_pylist(rows[:1]), manifest)
    code, text, errors = run("build", manifest, out, "--executor", "local")
    assert (code, "1 dropped" in text) == (0, True), errors
    assert run("build", manifest, out, "--executor", "local")[:1] == (0,)


def test_nothing_failed_is_said(run, tmp_path):
    build_tiny(write_manifest(tmp_path / "m.parquet", ["fine"]), tmp_path / "out")
    assert run("failures", tmp_path / "out")[:2] == (0, "none\n")


def test_where_scenes_were_dropped_none_failed_is_not_all(run, tmp_path):
    build_tiny(write_manifest(tmp_path / "m.parquet", ["fine", "empty", "fell"]), tmp_path / "out")
    query = f"""tableverse query {tmp_path / "out"} --where "status = 'dropped'" --columns scene_id,reason,detail"""
    said = f"none failed\nwhy 2 were dropped: {query}\n"
    assert run("failures", tmp_path / "out")[:2] == (0, said)
    assert run("failures", tmp_path / "out", "--stage", "pack")[:2] == (0, "none\n")


@pytest.mark.parametrize("command", ["status", "failures"])
def test_no_build_there_is_one_clear_line(run, tmp_path, command):
    code, _, errors = run(command, tmp_path)
    assert code == 1
    assert errors.startswith("error: ")
    assert "holds no build" in errors
    assert "Traceback" not in errors


def test_build_accounts_for_rejected_rows_without_running_anything(run, tmp_path):
    rows = [{"scene_id": f"s{i}", "kind": "capture", "uri": "/x", "rejected": "unreadable_color"} for i in range(3)]
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "m.parquet")
    command = ("build", tmp_path / "m.parquet", tmp_path / "out", "--executor", "local")
    code, text, _ = run(*command)
    assert code == 0
    assert "0 done, 3 dropped, 0 failed of 3 scenes" in text
    code, _, errors = run(*command, "--set", "run.seed=9")
    assert code == 1
    assert "config.run.seed was 0 and is now 9" in errors
    assert run("build", tmp_path / "absent.parquet", tmp_path / "out")[0] == 1
    assert "one worker" in run(*command, "--workers", 4)[2]


def test_build_ends_with_its_own_code_where_scenes_failed(run, tmp_path):
    """A capture that is not there is dropped or failed by the real line, never lost; both are accounted for."""
    rows = [{"scene_id": "gone", "kind": "layout", "uri": str(tmp_path / "gone.json")}]
    pq.write_table(pa.Table.from_pylist(rows), tmp_path / "m.parquet")
    code, text, _ = run("build", tmp_path / "m.parquet", tmp_path / "out", "--executor", "local")
    found = json.loads(run("status", tmp_path / "out", "--json")[1])
    assert found["remaining"] == 0
    assert code == (3 if found["failed"] else 0)
    assert ("tableverse failures" in text) == bool(found["failed"])
    assert ("tableverse query" in text) == bool(found["dropped"])


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("me:hush@head:6379", ": an address holds no user, password or query: give auto, or HOST:PORT"),
        ("ray://me:hush@head:6379", ": an address holds no user, password or query: give auto, or HOST:PORT"),
        ("nonsense", " nonsense: give auto, or HOST:PORT"),
        ("head:99999", " head:99999: give auto, or HOST:PORT"),
    ],
)
def test_an_address_is_checked_before_anything_is_said_of_it(run, tmp_path, monkeypatch, address, says):
    """An option, or the variable, which is named then."""
    write_manifest(tmp_path / "m.parquet", ["fine"])
    asked = ("build", tmp_path / "m.parquet", tmp_path / "out")
    for named, options in (("--address", ["--address", address]), ("RAY_ADDRESS", [])):
        monkeypatch.delenv("RAY_ADDRESS", raising=False)
        if not options:
            monkeypatch.setenv("RAY_ADDRESS", address)
        code, text, errors = run(*asked, *options)
        assert code == 1
        assert f"{named}{says}" in " ".join(errors.split())
        assert "hush" not in text + errors
    assert not (tmp_path / "out").exists()


def test_a_file_above_out_is_named(run, tmp_path):
    write_manifest(tmp_path / "m.parquet", ["fine"])
    code, _, errors = run("build", tmp_path / "m.parquet", tmp_path / "m.parquet" / "a" / "out", "--executor", "local")
    assert code == 1
    assert " ".join(errors.split()).startswith(f"error: {tmp_path}/m.parquet is a file: give another OUT help: ")
