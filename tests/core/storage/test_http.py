"""Datasets behind HTTP: few bytes, and one clear error for everything that a server can do wrong."""

import json
import os
import pickle
import socket
import time
from collections.abc import Iterator
from dataclasses import replace

import mujoco
import pyarrow.compute as pc
import pytest

from tableverse_factory.core.errors import InputError, StoreError
from tableverse_factory.core.storage import http
from tableverse_factory.core.storage.http_redirects import check_peer, find_networks, resolve_redirect
from tableverse_factory.core.storage.parquet import _OPEN_FILES
from tableverse_factory.dataset.consolidated_tables import write_merged_tables
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.dataset.shard_plan import Plan, write_plan
from tests.helpers.public_dataset import files_of, write_public_dataset, write_shard
from tests.helpers.range_server import Handler, RangeServer, range_server

GIB = 1024**3
SCENE_BYTES = 3_000_000
TAR = "mjcf/shard-00001.tar"


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    """Two shards; the tar of the second is a gibibyte long, of which the disk holds what is in it."""
    out = write_public_dataset(tmp_path_factory.mktemp("web") / "out", scenes=2, n_bytes=SCENE_BYTES)
    write_shard(out, 1, 2, SCENE_BYTES, "CC-BY-4.0", start=GIB - 8_000_000)
    assert (out / TAR).stat().st_size > GIB - 2_000_000
    assert (out / TAR).stat().st_blocks * 512 < 20_000_000
    return out


@pytest.fixture
def server(dataset, monkeypatch) -> Iterator[RangeServer]:
    monkeypatch.setattr(http, "RETRY_POLICY", replace(http.RETRY_POLICY, backoff_s=0.01))
    with range_server(dataset) as running:
        yield running


@pytest.mark.heavy
def test_a_scene_of_a_shard_of_a_gigabyte_costs_its_own_bytes(server):
    """Held to: less than twice the scene's bytes. Counted: all that the server sent, tables too."""
    scene = open_dataset(server.address).scene("s-1-1")
    assert scene.files() == dict(files_of("s-1-1", SCENE_BYTES))
    size = scene.row["tar_size"]
    assert server.sent[TAR] == size
    assert sum(server.sent.values()) < 1.01 * size
    assert server.asked.total() == 4  # run.json, plan, the shard's rows, the scene
    server.forget()
    assert open_dataset(server.address).scene("s-1-0").model().nbody == 3


def test_the_next_scene_of_the_same_shard_needs_no_plan(server):
    opened = open_dataset(server.address)
    opened.scene("s-1-0")
    server.forget()
    opened.scene("s-1-1")
    assert set(server.asked) == {"scenes/shard-00001.parquet", TAR}


@pytest.mark.heavy
def test_the_tables_are_read_and_queried(server, run):
    others = list(_OPEN_FILES)  # of tests before this one
    opened = open_dataset(server.address)
    assert opened.scenes.count_rows() == 4
    found = opened.objects.to_table(columns=["label"], filter=pc.field("scene_id") == "s-1-0")
    assert found.to_pylist() == [{"label": "mug"}]
    assert opened.trajectories.count_rows() == 0
    assert opened.scene("s-0-0").trajectories() == ()
    assert not server.sent[TAR]
    code, text, _ = run("query", server.address, "--where", "shard = 1", "--json")
    assert (code, [row["scene_id"] for row in json.loads(text)]) == (0, ["s-1-0", "s-1-1"])
    assert run("stats", server.address + "/", "--json")[0] == 0
    until = time.monotonic() + 10
    while len(_OPEN_FILES) > len(others) and time.monotonic() < until:
        time.sleep(0.01)
    assert len(_OPEN_FILES) <= len(others), "Arrow lets go of every file, or the interpreter would wait for it"


@pytest.mark.heavy
def test_a_scene_is_extracted(server, run, tmp_path):
    assert run("extract", server.address, tmp_path / "scene", "--scene", "s-1-1")[0] == 0
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "scene" / "scene.xml")).nbody == 3
    code, _, errors = run("extract", server.address, tmp_path / "other", "--scene", "s-1-11")
    assert code == 1
    assert "nearest: s-1-1" in errors


@pytest.mark.heavy
def test_a_dataset_goes_to_another_process(server):
    """As the workers of a DataLoader get it."""
    opened = open_dataset(server.address)
    opened.scene("s-1-0")
    copy = pickle.loads(pickle.dumps(opened))
    assert copy.scene("s-1-1").files() == dict(files_of("s-1-1", SCENE_BYTES))
    assert copy.objects.count_rows() == 4


@pytest.mark.heavy
def test_many_shards_are_read_from_one_table(tmp_path):
    out = write_public_dataset(tmp_path / "out", shards=20, scenes=1, n_bytes=10)
    write_merged_tables(out, 20)
    with range_server(out) as server:
        opened = open_dataset(server.address)
        assert opened.objects.to_table()["scene_id"].to_pylist() == sorted(
            (f"s-{shard}-0" for shard in range(20)), key=lambda name: int(name.split("-")[1])
        )
        assert server.sent["objects/shard-00007.parquet"] <= 1  # its length was asked for, nothing of it was read
        assert server.sent["merged/objects.parquet"] > 0
        (out / "objects" / "shard-00007.parquet").write_bytes((out / "objects" / "shard-00008.parquet").read_bytes())
        (out / "merged" / "objects.parquet").write_bytes(b"another build began")
        assert open_dataset(server.address).objects.count_rows() == 20


@pytest.mark.heavy
def test_a_merged_table_that_a_server_fails_to_give_is_an_error_and_not_a_thousand_questions(tmp_path, monkeypatch):
    monkeypatch.setattr(http, "RETRY_POLICY", replace(http.RETRY_POLICY, backoff_s=0.01))
    out = write_public_dataset(tmp_path / "out", shards=20, scenes=1, n_bytes=10)
    write_merged_tables(out, 20)
    with range_server(out) as server:
        opened = open_dataset(server.address)
        server.fault = lambda handler, name: name.startswith("merged/") and answering_all(handler, 503)
        with pytest.raises(InputError, match=r"merged/objects\.parquet: the server answers 503 \(asked 5 times\)"):
            _ = opened.objects


@pytest.mark.heavy
def test_what_is_not_finished_is_read_as_far_as_it_is(tmp_path):
    out = write_public_dataset(tmp_path / "out", shards=3, n_bytes=10)
    (out / "scenes" / "shard-00001.parquet").unlink()
    with range_server(out) as server:
        opened = open_dataset(server.address)
        assert opened.shards == (0, 2)
        assert opened.scenes.count_rows() == 4
        with pytest.raises(InputError, match="s-1-0 is planned and not there yet"):
            opened.scene("s-1-0")
        (out / "plan.parquet").unlink()
        with pytest.raises(StoreError, match=r"plan\.parquet is missing: HTTP lists no folders"):
            _ = open_dataset(server.address).scenes


def test_an_answer_that_breaks_off_is_gone_on_with(server):
    starts = []

    def cut(handler: Handler, name: str) -> bool:
        if name != TAR:
            return False
        starts.append(handler.span(2 * GIB)[0])
        if len(starts) > 2:
            return False
        start, stop = handler.span((server.folder / TAR).stat().st_size)
        handler.send_response(206)
        handler.send_header("Content-Range", f"bytes {start}-{stop - 1}/{(server.folder / TAR).stat().st_size}")
        handler.send_header("Content-Length", str(stop - start))
        handler.send_header("ETag", etag_of(server))
        handler.end_headers()
        with (server.folder / TAR).open("rb") as file:
            file.seek(start)
            handler.wfile.write(file.read(1_000_000))
        handler.close_connection = True
        return True

    server.fault = cut
    assert open_dataset(server.address).scene("s-1-1").files() == dict(files_of("s-1-1", SCENE_BYTES))
    assert [start - starts[0] for start in starts] == [0, 1_000_000, 2_000_000]


def etag_of(server: RangeServer) -> str:
    found = (server.folder / TAR).stat()
    return f'"{found.st_mtime_ns}-{found.st_size}"'


def answering(status: int, body: bytes = b"", **headers: str):
    def fault(handler: Handler, name: str) -> bool:
        if name == TAR:
            handler.answer(status, body, {key.replace("_", "-"): value for key, value in headers.items()})
        return name == TAR

    return fault


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("fault", "message"),
    [
        (answering(200, b"x" * 100), "does not serve ranges of bytes"),
        (answering(206, b"x" * 100), "the server gives no Content-Range"),
        (answering(206, b"x" * 100, Content_Range="bytes 0-99/100"), "the server gives bytes 0-99/100"),
        (answering(206, b"x" * 100, Content_Range="bytes 1-\x1b/9"), "the server gives bytes"),
        (answering(206, b"x", Content_Encoding="gzip"), "compresses ranges"),
        (answering(403), "the server refuses (403)"),
        (answering(404), "there is no such file"),
        (answering(418), "the server answers 418"),
        (answering(500), "the server answers 500 (asked 5 times)"),
        (answering(429, b"", Retry_After="0"), "the server answers 429 (asked 5 times)"),
        (answering(503, b"", Retry_After="86400"), "asks to wait 86400 s (asked 1 time)"),
        (answering(416, b"", Content_Range="bytes */1000"), "cut short"),
        (answering(416), "refuses bytes"),
        (answering(302, b"", Location="http://169.254.169.254/latest/meta-data"), "a link-local address"),
        (answering(302, b"", Location="http://10.1.2.3/x"), "a private address"),
        (answering(302, b"", Location="http://0.0.0.0:1/x"), "a special address"),
        (answering(302, b"", Location="http://[::ffff:10.0.0.1]/x"), "a private address"),
        (answering(302, b"", Location="file:///etc/passwd"), "no address of the web"),
        (answering(302, b"", Location="http://[broken/"), "no address"),
        (answering(302, b"", Location="/" + TAR), "more than 5 redirects"),
    ],
)
def test_what_a_server_does_wrong_is_one_error(server, fault, message):
    server.fault = fault
    opened = open_dataset(server.address)
    with pytest.raises((InputError, StoreError)) as caught:
        opened.scene("s-1-1")
    assert message in str(caught.value)
    assert str(caught.value).isprintable()
    assert TAR in str(caught.value)
    assert len(str(caught.value)) < 500


def test_a_longer_answer_than_was_asked_for_is_not_taken(server):
    server.fault = lambda handler, name: name == TAR and _too_long(handler)
    with pytest.raises(InputError, match="longer than it says"):
        open_dataset(server.address).scene("s-1-1")


def _too_long(handler: Handler) -> bool:
    start, stop = handler.span(GIB)
    handler.answer(206, b"x" * (stop - start + 7), {"Content-Range": f"bytes {start}-{stop - 1}/{GIB * 2}"})
    return True


def test_a_busy_server_is_asked_again(server):
    left = [503, 500]
    server.fault = lambda handler, name: (
        bool(left) and name == TAR and answering(left.pop(), b"", Retry_After="0")(handler, name)
    )
    assert open_dataset(server.address).scene("s-1-1").files() == dict(files_of("s-1-1", SCENE_BYTES))
    assert server.asked[TAR] == 3


@pytest.mark.heavy
def test_a_file_that_changed_is_not_mixed_with_what_it_was(tmp_path):
    out = write_public_dataset(tmp_path / "out", n_bytes=10)
    with range_server(out) as server:
        opened = open_dataset(server.address)
        opened.scene("s-1-0")
        os.utime(out / TAR, ns=(1, 1))
        with pytest.raises(InputError, match="changed since the dataset was opened"):
            opened.scene("s-1-1")
        assert open_dataset(server.address).scene("s-1-1").files() == dict(files_of("s-1-1", 10))


@pytest.mark.heavy
def test_a_server_without_ranges_still_gives_small_files(server):
    server.ranges = False
    opened = open_dataset(server.address)
    assert opened.scenes.count_rows() == 4
    with pytest.raises(InputError, match="does not serve ranges of bytes"):
        opened.scene("s-1-1")


@pytest.mark.heavy
def test_a_bucket_that_may_not_be_listed_lacks_what_it_refuses(tmp_path):
    """As public buckets on S3 answer: 403 for every name that is not there."""
    out = write_public_dataset(tmp_path / "out", shards=4, scenes=1, n_bytes=10)
    (out / "scenes" / "shard-00002.parquet").unlink()

    def refuse(handler: Handler, name: str) -> bool:
        missing = not (out / name).is_file()
        if missing:
            handler.answer(403, b"AccessDenied")
        return missing

    with range_server(out) as server:
        server.fault = refuse
        opened = open_dataset(server.address)
        assert opened.scene("s-1-0").trajectories() == ()
        assert len(opened.shards) == 3
        assert opened.trajectories.count_rows() == 0
        assert opened.objects.count_rows() == 3
        (out / "objects" / "shard-00003.parquet").unlink()
        with pytest.raises(
            (InputError, StoreError), match=r"refuses \(403\).*may not be listed, there is no such file"
        ):
            _ = open_dataset(server.address).objects
        (out / "run.json").unlink()
        with pytest.raises(InputError, match=r"refuses \(403\)"):
            open_dataset(server.address)


def test_a_bucket_that_lets_nobody_read_its_shards_is_not_an_empty_dataset(tmp_path):
    out = write_public_dataset(tmp_path / "out", n_bytes=10)
    with range_server(out) as server:
        server.fault = lambda handler, name: name.startswith("scenes/") and answering_all(handler, 403)
        with pytest.raises(StoreError, match="the server refuses every shard"):
            _ = open_dataset(server.address).shards


def answering_all(handler: Handler, status: int) -> bool:
    handler.answer(status, b"")
    return True


def test_what_is_not_there_is_asked_for_once(server):
    opened = open_dataset(server.address)
    for scene in ("s-1-0", "s-1-1"):
        assert opened.scene(scene).trajectory_rows() == []
    assert opened.trajectories.count_rows() == 0
    assert server.asked["trajectories/shard-00001.parquet"] == 1


def test_a_plan_of_a_stranger_costs_no_more_questions_than_it_has_rows(tmp_path):
    out = write_public_dataset(tmp_path / "out", n_bytes=10)
    write_plan(out / "plan.parquet", Plan(("s-0-0", "s-1-0"), ("capture",) * 2, (0, 4999)))
    with range_server(out) as server:
        assert open_dataset(server.address).shards == (0,)
        assert server.asked.total() == 4
        write_plan(out / "plan.parquet", Plan(("s-0-0", "s-1-0"), ("capture",) * 2, (0, 2**31 - 1)))
        with pytest.raises(StoreError, match="it speaks of shards 0 to 2147483647"):
            _ = open_dataset(server.address).shards


def test_a_redirect_within_the_same_network_is_followed(server, dataset):
    with range_server(dataset) as other:
        server.fault = answering(302, Location=f"{other.address}/{TAR}?signature=x")
        assert open_dataset(server.address).scene("s-1-1").files() == dict(files_of("s-1-1", SCENE_BYTES))
        assert (server.sent[TAR], other.asked[TAR]) == (0, 1)


@pytest.mark.parametrize(
    ("first", "location", "refused"),
    [
        ("https://93.184.216.34/a/b", "/c", None),
        ("https://93.184.216.34/a", "https://1.1.1.1/b?X-Amz-Signature=secret", None),
        ("https://93.184.216.34/a", "http://1.1.1.1/b", "from https to http"),
        ("https://93.184.216.34/a", "https://127.0.0.1/b", "a loopback address"),
        ("https://93.184.216.34/a", "https://192.168.0.9/b", "a private address"),
        ("https://93.184.216.34/a", "https://[::1]/b", "a loopback address"),
        ("https://192.168.0.9/a", "https://192.168.0.10/b", None),
        ("https://192.168.0.9/a", "https://169.254.169.254/b", "a link-local address"),
        ("https://192.168.0.9/a", "https://1.1.1.1/b", None),
    ],
)
def test_redirects_stay_in_the_open_network(first, location, refused):
    if refused is None:
        assert resolve_redirect(first, first, location).startswith("https://")
        return
    with pytest.raises(StoreError, match=refused) as caught:
        resolve_redirect(first, first, location + "?X-Amz-Signature=secret")
    assert "secret" not in str(caught.value)


def test_a_name_that_leads_elsewhere_a_moment_later_gives_nothing(server, dataset, monkeypatch):
    """What is looked up before the connection may be another answer than what the connection is made to."""
    own, asked, lookup = _own_address(), [], socket.getaddrinfo

    def rebound(host, *arguments, **named):
        if host != "rebound.test":
            return lookup(host, *arguments, **named)
        asked.append(host)
        if len(asked) == 1:
            raise socket.gaierror
        return lookup(own, *arguments, **named)

    monkeypatch.setattr(socket, "getaddrinfo", rebound)
    with range_server(dataset, own) as inner:
        server.fault = answering(302, Location=f"{inner.address.replace(own, 'rebound.test')}/{TAR}")
        with pytest.raises(InputError, match=r"redirected to http://rebound\.test.*, a private address"):
            open_dataset(server.address).scene("s-1-1")
        assert inner.asked[TAR] == 1


def _own_address() -> str:
    """Of this machine in a private network."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # nothing is sent
        except OSError:
            pytest.skip("this machine is in no network")
        own = str(probe.getsockname()[0])
    if find_networks(f"http://{own}") != {"private"}:
        pytest.skip("this machine is in no private network")
    return own


@pytest.mark.parametrize(
    ("home", "peer", "refused"),
    [
        ("93.184.216.34", "1.1.1.1", None),
        ("93.184.216.34", "10.0.0.1", "a private address"),
        ("93.184.216.34", "::ffff:127.0.0.1", "a loopback address"),
        ("93.184.216.34", "fe80::1%eth0", "a link-local address"),
        ("10.0.0.1", "10.0.0.2", None),
        ("10.0.0.1", "127.0.0.1", "a loopback address"),
    ],
)
def test_the_machine_that_answers_is_what_counts(home, peer, refused):
    if refused is None:
        check_peer("https://a.test/x", "https://b.test/x", home, peer)
        return
    with pytest.raises(StoreError, match=refused):
        check_peer("https://a.test/x", "https://b.test/x", home, peer)


def test_a_name_that_nobody_knows_counts_as_public():
    assert find_networks("https://no-such-host.invalid/x") == {"public"}
    assert find_networks("http://localhost:80/x") == {"loopback"}


@pytest.mark.parametrize(
    "address",
    [
        "https://",
        "https:///path",
        "https://user:hunter2@host/x",
        "https://host/x?X-Amz-Signature=hunter2",
        "https://host/x#hunter2",
        "https://host:99999/x",
        "https://[broken/x",
        "https://ho st/x",
        "https://host/\x1b[2J",
        "https://host/" + "x" * 2000,
    ],
)
def test_an_address_that_is_none_is_said_without_its_secrets(address):
    with pytest.raises(InputError) as caught:
        open_dataset(address)
    assert "hunter2" not in str(caught.value)
    assert str(caught.value).isprintable()


@pytest.mark.heavy
def test_nothing_there_and_nobody_there_are_said(server, run):
    for place, message in ((f"{server.address}/nowhere", "no such folder"), ("http://127.0.0.1:9/x", "no answer (")):
        code, _, errors = run("query", place)
        assert (code, errors.count("\n")) == (1, 2)
        assert message in errors
