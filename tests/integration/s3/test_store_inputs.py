"""A store that fails says nothing about the captures in it: no scene is dropped for it, and none gets another id."""

import time

import pytest

from schemas.config import Config, ObserveConfig
from schemas.manifest import SceneKind
from schemas.pools import Pools
from schemas.work import SandboxSetup
from tableverse_factory.core.errors import InputError, StoreError
from tableverse_factory.core.storage.untrusted import exists, list_file_names
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.run_record import collect_versions
from tableverse_factory.sources.capture import read_capture, read_detections
from tableverse_factory.sources.content_hash import hash_entry
from tableverse_factory.sources.manifest import make_manifest
from tests.helpers.captures_on_disk import write_capture, write_layout, write_picture
from tests.helpers.small_dataset import write_small_dataset
from tests.integration.s3.test_store_readers import upload
from workers.executors.preflight import NodeExpectation
from workers.executors.protocol import WorkerLost
from workers.executors.ray_executor import ClusterSpec, RayExecutor

BOUNDS = ObserveConfig()


@pytest.fixture
def impatient(monkeypatch):
    monkeypatch.setattr("tableverse_factory.core.storage.s3._ATTEMPTS", 1)


@pytest.fixture
def capture(store, tmp_path):
    """A capture with a recorded mesh, and the same on the disk."""
    here = write_capture(tmp_path / "one", 1)
    (here / "meshes").mkdir()
    (here / "meshes" / "1.obj").write_bytes(b"v 0 0 0\n")
    upload(here, store / "one")
    return store / "one", here


def test_a_capture_is_the_same_in_a_store_and_on_the_disk(capture):
    place, here = capture
    in_store, on_disk = (hash_entry(SceneKind.CAPTURE, str(folder), BOUNDS) for folder in (place, here))
    assert in_store == on_disk
    assert read_capture(str(place), BOUNDS).detections is None
    assert [exists(f"{place}/{name}") for name in ("color.png", "meshes", "color.jpg")] == [True, False, False]
    assert list_file_names(f"{place}/meshes") == ("1.obj",)
    assert list_file_names(f"{place}/nothing") == ()


@pytest.mark.parametrize("fault", ["refused", pytest.param("error", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", ["color.png", "detections.json", "masks.png", "meshes"])
def test_no_answer_about_a_file_is_not_its_absence(capture, proxy, impatient, fault, name):
    place, _ = capture
    proxy.fault = lambda method, path: fault if name in path else None
    with pytest.raises(StoreError, match=rf"one/{name}"):
        hash_entry(SceneKind.CAPTURE, str(place), BOUNDS)
    if name != "meshes":
        with pytest.raises(StoreError, match=rf"one/{name}"):
            read_capture(str(place), BOUNDS)


def test_a_passing_failure_changes_nothing(capture, proxy, tmp_path):
    place, here = capture
    failing = iter(["error", "refused"])
    proxy.fault = lambda method, path: next(failing, None) if "detections.json" in path else None
    assert hash_entry(SceneKind.CAPTURE, str(place), BOUNDS) == hash_entry(SceneKind.CAPTURE, str(here), BOUNDS)
    assert proxy.faults == 2


def test_a_bucket_that_is_not_there_is_no_empty_capture(store, impatient):
    with pytest.raises(StoreError, match="there is no bucket no-such-bucket"):
        read_detections("s3://no-such-bucket/one")


@pytest.mark.parametrize("fault", ["error", pytest.param("refused", marks=pytest.mark.slow)])
def test_a_folder_that_cannot_be_listed_is_not_left_out_of_a_manifest(store, proxy, impatient, tmp_path, fault):
    write_picture(tmp_path / "in" / "a" / "one.png", 1)
    write_picture(tmp_path / "in" / "b" / "two.png", 2)
    write_layout(tmp_path / "in" / "c" / "scene.json")
    upload(tmp_path / "in", store)
    assert len(make_manifest([str(store)], BOUNDS).rows) == 3
    proxy.fault = lambda method, path: fault if "list-type" in path and "prefix%2Fb%2F" in path else None
    with pytest.raises((InputError, StoreError), match="/b"):
        make_manifest([str(store)], BOUNDS)
    proxy.fault = lambda method, path: fault if method == "HEAD" and path.endswith("scene.json") else None
    with pytest.raises((InputError, StoreError), match=r"scene\.json"):
        make_manifest([str(store)], BOUNDS)


@pytest.mark.parametrize("fault", ["error", pytest.param("refused", marks=pytest.mark.slow)])
def test_a_dataset_whose_tables_cannot_be_listed_is_not_an_empty_one(store, proxy, impatient, tmp_path, fault):
    upload(write_small_dataset(tmp_path / "out"), store)
    dataset = open_dataset(str(store))
    proxy.fault = lambda method, path: fault if "list-type" in path else None
    with pytest.raises(StoreError, match="scenes"):
        dataset.scenes.count_rows()
    with pytest.raises((InputError, StoreError), match=r"cannot be reached|the store"):
        open_dataset(str(store))


@pytest.mark.slow  # tests above hold what a store's silence means
def test_an_actor_whose_store_does_not_answer_is_lost_and_the_build_goes_on(store, proxy, impatient, tmp_path):
    proxy.fault = lambda method, path: "denied"
    records = str(tmp_path / "records")
    setup = SandboxSetup(
        "tests.helpers.tiny_pipeline:PIPELINES", Config().model_dump_json(), str(tmp_path), 1, 2000, records
    )
    executor = RayExecutor(setup, Pools(), ClusterSpec(None, 1, [], tmp_path))
    try:
        executor._expected = NodeExpectation(collect_versions(), (f"{store}/one",))
        worker = executor.start(executor.pool_of("geometry"))
        until = time.monotonic() + 60.0
        while not (events := executor.wait(1.0)):
            assert time.monotonic() < until
    finally:
        executor.close()
    (event,) = events
    assert isinstance(event, WorkerLost)
    assert (event.worker, event.work) == (worker, ())
    assert event.why.startswith(f"{store}/one: access denied")
