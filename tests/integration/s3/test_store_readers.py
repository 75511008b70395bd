"""What reads a dataset or makes a manifest does so in a store, without fetching what it does not need."""

import json
from dataclasses import replace

import pytest

from schemas.config import ObserveConfig
from schemas.manifest import ImageRow
from tableverse_factory.core.errors import InputError, StoreError
from tableverse_factory.core.storage.files import get_store, list_names, parse_path
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.sources.content_hash import verify_content_hash
from tableverse_factory.sources.manifest import make_manifest
from tests.helpers.builds import Silent, digests, request, write_manifest
from tests.helpers.captures_on_disk import write_capture, write_layout, write_picture
from tests.helpers.small_dataset import scene_files, write_small_dataset
from tests.helpers.store_contents import digests_in
from workers.run import run_build


def upload(folder, place):
    """Everything below a folder."""
    for path in folder.rglob("*"):
        if path.is_file():
            get_store(place).pipe_file(f"{place.path}/{path.relative_to(folder)}", path.read_bytes())


def test_a_scene_is_fetched_without_its_shard(store, proxy, tmp_path):
    upload(write_small_dataset(tmp_path / "out"), store)
    dataset = open_dataset(str(store))
    dataset.scene("c-3")
    proxy.passed.clear()
    assert dataset.scene("c-4").files() == dict(scene_files("c-4"))
    of_tars = [p for p in proxy.passed if ".tar" in p.path]
    assert [p.method for p in of_tars] == ["GET"]
    row = dataset.scene("c-4").row
    assert of_tars[0].answered == row["tar_size"]


def test_a_dataset_in_a_store_is_queried_and_extracted(store, run, tmp_path):
    upload(write_small_dataset(tmp_path / "out"), store)
    code, text, _ = run("query", store, "--where", "status = 'done'", "--json")
    assert (code, [row["scene_id"] for row in json.loads(text)]) == (0, ["a-1", "c-3", "c-4"])
    assert run("extract", store, tmp_path / "scene", "--scene", "a-1")[0] == 0
    assert (tmp_path / "scene" / "scene.xml").read_bytes() == dict(scene_files("a-1"))["scene.xml"]
    assert run("stats", store, "--json")[0] == 0
    code, _, errors = run("query", parse_path("s3://no-such-bucket/x"))
    assert code == 1
    assert "there is no bucket no-such-bucket" in errors


def test_a_folder_in_a_store_becomes_the_manifest_that_it_becomes_on_the_disk(store, run, tmp_path):
    here = tmp_path / "in"
    write_capture(here / "captures" / "one", 1)
    write_capture(here / "captures" / "two", 2)
    write_layout(here / "layouts" / "scene.json")
    write_picture(here / "photos" / "a.png", 3)
    (here / "photos" / "source.json").write_text(json.dumps({"source": "me", "licence": "CC0-1.0"}))
    upload(here, store / "in")
    bounds = ObserveConfig()
    local, remote = make_manifest([str(here)], bounds), make_manifest([str(store / "in")], bounds)

    def without_place(row: ImageRow) -> dict:
        return {**row.model_dump(), "uri": row.uri.removeprefix(str(here)).removeprefix(str(store / "in"))}

    assert [without_place(row) for row in remote.rows] == [without_place(row) for row in local.rows]
    assert len(remote.rows) == 4
    assert not any(row.rejected for row in remote.rows)
    assert remote.ignored == local.ignored
    for row in remote.rows:
        verify_content_hash(row, bounds)
    code, text, _ = run("manifest", store / "in", "--out", store / "images.parquet")
    assert (code, "4 rows in s3://" in text) == (0, True)
    assert "images.parquet" in list_names(store)


def test_a_store_that_fails_makes_no_rows(store, proxy, tmp_path, monkeypatch):
    """An outage says nothing about a picture: it must not stand in a manifest as a bad one."""
    write_picture(tmp_path / "a.png", 3)
    upload(tmp_path, store)
    monkeypatch.setattr("tableverse_factory.core.storage.s3._ATTEMPTS", 1)
    proxy.fault = lambda method, path: "error" if method == "GET" and path.endswith("a.png") else None
    with pytest.raises(StoreError, match=r"a\.png.*the store answers"):
        make_manifest([str(store)], ObserveConfig())
    with pytest.raises(InputError, match="no such file or folder"):
        make_manifest([f"{store}/nothing"], ObserveConfig())


@pytest.mark.slow  # test_commands.py does it on the disk
def test_status_failures_and_export_of_a_build_in_a_store(store, run, tmp_path):
    manifest = write_manifest(tmp_path / "m.parquet", ["fine", "sad", "fell", "fine", "fine"])
    run_build(replace(request(manifest, tmp_path / "x", deadline_s=60.0), out=store / "out"), Silent())
    code, text, _ = run("status", store / "out", "--json")
    assert (code, json.loads(text)["done"]) == (0, 3)
    assert "3 vertices cannot close a surface" in " ".join(run("failures", store / "out")[1].split())
    assert "1 scene in 1 shard put back" in run("failures", store / "out", "--retry")[1]
    run_build(replace(request(manifest, tmp_path / "x", deadline_s=60.0), out=store / "out"), Silent())
    assert run("export", store / "out", store / "public")[0] == 0
    assert run("export", store / "out", tmp_path / "public")[0] == 0
    assert digests_in(store / "public") == digests(tmp_path / "public")
