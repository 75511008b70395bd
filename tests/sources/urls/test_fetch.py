"""Lists of addresses become a manifest, whatever the servers behind them do."""

import csv
import json
import os
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image, ImageFilter

from schemas.config import ObserveConfig
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.version import __version__
from tableverse_factory.sources.image_file import read_image
from tableverse_factory.sources.manifest import make_manifest, write_manifest
from tableverse_factory.sources.urls import fetch
from tableverse_factory.sources.urls.fetch import FetchBounds
from tableverse_factory.sources.urls.fetch_lists import fetch_lists
from tableverse_factory.sources.urls.image_filter import FilterCriteria
from tableverse_factory.sources.urls.lists import read_list
from tests.helpers.captures_on_disk import huge_png, write_capture, write_picture
from tests.helpers.picture_server import body, drip, encoded, endless, in_turn, packed, photo, picture_server, redirect

BOUNDS = ObserveConfig()
HERE = FetchBounds(allow_private=True, timeout_s=5.0, max_bytes=2_000_000)


@pytest.fixture
def pictures():
    with picture_server() as server:
        yield server


@pytest.fixture(autouse=True)
def impatient(monkeypatch):
    monkeypatch.setattr(fetch, "RETRY_POLICY", replace(fetch.RETRY_POLICY, backoff_s=0.01))


def write_list(path: Path, rows) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerows([("url", "source", "licence"), *rows])
    return path


def made(folder: Path, urls, fetching=HERE, criteria=None):
    rows = [(url, "", "") if isinstance(url, str) else url for url in urls]
    listed = fetch_lists([str(write_list(folder / "list.csv", rows))], folder / "pictures", fetching, BOUNDS)
    return make_manifest([], BOUNDS, listed, criteria).rows, listed


def only(folder: Path, url: str, **changes):
    ((row,), _) = made(folder, [url], FetchBounds(**{"allow_private": True, "timeout_s": 5.0, **changes}))
    return row


def test_a_picture_comes_with_its_address_source_and_licence(pictures, tmp_path):
    data = encoded(photo(1))
    pictures.answers["/a/mug%20one.jpg"] = body(data)
    url = f"{pictures.url}/a/mug%20one.jpg?token=hush#top"
    ((row,), listed) = made(tmp_path, [(url, "a shop\x1b[2J", "CC-BY-4.0")])
    assert (row.rejected, row.name, row.source, row.licence) == ("", "mug one.jpg", "a shop\\x1b[2J", "CC-BY-4.0")
    assert row.url == f"{pictures.url}/a/mug%20one.jpg"
    assert Path(row.uri).read_bytes() == data
    assert Path(row.uri).stem == row.content_sha256
    assert pictures.agents == {f"tableverse-factory/{__version__}"}
    assert (listed.fetched, listed.earlier) == (1, 0)
    kept = b"".join(path.read_bytes() for path in tmp_path.rglob("index.jsonl"))
    assert b"hush" not in kept
    assert b"127.0.0.1" not in kept


def test_a_picture_is_fetched_once_and_a_damaged_one_again(pictures, tmp_path):
    pictures.answers |= {f"/{number}.png": body(encoded(photo(number), "PNG")) for number in range(3)}
    urls = [f"{pictures.url}/{number}.png" for number in range(3)]
    first, _ = made(tmp_path, [*urls, urls[0]])
    assert [row.rejected for row in first] == ["", "", "", "duplicate_of"]
    index = tmp_path / "pictures" / "index.jsonl"
    index.write_bytes(index.read_bytes() + b'{"url": "torn')
    Path(first[1].uri).write_bytes(b"damaged")
    Path(first[2].uri).unlink()
    again, listed = made(tmp_path, [*urls, urls[0]])
    assert again == first
    assert (listed.fetched, listed.earlier) == (2, 1)
    assert pictures.asked == {"/0.png": 1, "/1.png": 2, "/2.png": 2}
    _, listed = made(tmp_path, urls)
    assert (listed.fetched, listed.earlier) == (0, 3)


ANSWERS = {
    "http_error": body(b"gone", 404),
    "http_error after three": body(b"broken", 500),
    "too_many_redirects": redirect("/x.jpg"),
    "bad_url to a file": redirect("file:///etc/passwd"),
    "bad_url with a password": redirect("http://user:hush@127.0.0.1/"),
    "bad_url nowhere": redirect("http://[::"),
    "bad_url to no port": redirect("http://127.0.0.1:70000/"),
    "file_too_large by its header": body(b"x", content_length="99999999999"),
    "file_too_large endless": endless,
    "too_slow": drip,
    "unreachable, cut off": body(b"\xff\xd8", content_length="5000"),
    "compressed_answer": packed(b"\0" * 50_000_000),
    "unreadable_color html": body(b"<html><body>not found</body></html>"),
    "unreadable_color svg": body(b'<svg xmlns="http://www.w3.org/2000/svg"/>', content_type="image/svg+xml"),
    "unreadable_color empty": body(b""),
    "unreadable_color truncated": body(encoded(photo(1))[:-3000]),
    "unreadable_color shorter than it is": body(encoded(photo(1)), content_length="4000"),
    "unreadable_color tiff": body(encoded(photo(1), "TIFF")),
    "picture_too_large": body(huge_png(60_000, 60_000)),
    "animated_picture": body(encoded(photo(1), "PNG", save_all=True, append_images=[photo(2)])),
    "animated_picture webp": body(encoded(photo(1), "WEBP", save_all=True, append_images=[photo(2)])),
    "unsupported_pixels cmyk": body(encoded(photo(1).convert("CMYK"))),
    "unsupported_pixels 16 bit": body(encoded(Image.fromarray(np.full((300, 400), 9000, np.uint16)), "PNG")),
    "transparent_picture": body(encoded(photo(1).quantize(16), "PNG", transparency=0)),
}


@pytest.mark.heavy
@pytest.mark.parametrize("what", ANSWERS)
def test_what_a_server_does_wrong_is_a_row_with_its_reason(pictures, tmp_path, what):
    pictures.answers["/x.jpg"] = ANSWERS[what]
    row = only(tmp_path, f"{pictures.url}/x.jpg", timeout_s=1.0 if what == "too_slow" else 10.0, max_bytes=2_000_000)
    assert row.rejected == what.partition(" ")[0].strip(",")
    assert row.rejected_detail.isprintable()
    assert "hush" not in row.rejected_detail


@pytest.mark.heavy
def test_a_busy_server_is_asked_again_and_waited_for(pictures, tmp_path):
    sound = body(encoded(photo(1)))
    pictures.answers["/500.jpg"] = in_turn(body(b"", 500), sound)
    pictures.answers["/429.jpg"] = in_turn(body(b"", 429, retry_after="1"), sound)
    pictures.answers["/later.jpg"] = body(b"", 429, retry_after="3600")
    pictures.answers["/cut.jpg"] = in_turn(body(b"\xff\xd8", content_length="900"), sound)
    pictures.answers["/moved.jpg"] = redirect("/500.jpg")
    assert only(tmp_path, f"{pictures.url}/500.jpg").rejected == ""
    began = time.monotonic()
    assert only(tmp_path, f"{pictures.url}/429.jpg").rejected == ""
    assert time.monotonic() - began >= 1
    row = only(tmp_path, f"{pictures.url}/later.jpg")
    assert (row.rejected, pictures.asked["/later.jpg"]) == ("http_error", 1)
    assert "3600 s" in row.rejected_detail
    assert only(tmp_path, f"{pictures.url}/cut.jpg").rejected == ""
    assert only(tmp_path, f"{pictures.url}/moved.jpg").rejected == ""


HIDDEN_HOSTS = (
    *("127.0.0.1", "localhost", "2130706433", "0177.0.0.1", "0x7f.1", "127.1", "0.0.0.0", "[::1]", "[::]"),  # noqa: S104
    *("[::ffff:127.0.0.1]", "[::ffff:7f00:1]", "[64:ff9b::7f00:1]", "[2002:7f00:1::]", "10.0.0.1", "192.168.1.1"),
    *("172.16.0.1", "169.254.169.254", "100.64.0.1", "100.100.100.200", "[fd00:ec2::254]", "[fe80::1]", "224.0.0.1"),
    *("168.63.129.16", "255.255.255.255", "[ff02::1]", "[fec0::1]", "[::127.0.0.1]", "192.0.2.1"),
)


def test_no_address_of_this_network_is_asked(tmp_path, pictures):
    urls = [f"http://{host}:{pictures.url.rpartition(':')[2]}/a.jpg" for host in HIDDEN_HOSTS]
    rows, _ = made(tmp_path, urls, FetchBounds(timeout_s=5.0))
    assert {row.rejected for row in rows if "0177" not in row.url} == {"private_address"}
    assert {row.rejected for row in rows if "0177" in row.url} == {"bad_url"}
    assert not pictures.asked


def test_a_redirect_into_this_network_is_not_followed(pictures, tmp_path, monkeypatch):
    """The first host counts as public here: what it redirects to does not."""
    from tableverse_factory.sources.urls import addresses

    monkeypatch.setattr(addresses, "classify_address", lambda text: "public" if text == "127.0.0.1" else "private")
    with picture_server() as other:
        pictures.answers["/x.jpg"] = redirect(other.url.replace("127.0.0.1", "127.0.0.2"))
        assert only(tmp_path, f"{pictures.url}/x.jpg", allow_private=False).rejected == "private_address"
        assert not other.asked


def test_a_name_is_resolved_once_and_the_connection_goes_where_it_was_checked(pictures, tmp_path, monkeypatch):
    asked = []

    def rebinding(host, port, *_):
        asked.append(host)
        address = "127.0.0.1" if len(asked) == 1 else "10.0.0.1"
        return [(2, 1, 6, "", (address, port))]

    monkeypatch.setattr(socket, "getaddrinfo", rebinding)
    pictures.answers["/x.jpg"] = body(encoded(photo(1)))
    row = only(tmp_path, f"{pictures.url.replace('127.0.0.1', 'photos.example')}/x.jpg")
    assert (row.rejected, asked) == ("", ["photos.example"])
    mixed = [(2, 1, 6, "", ("93.184.215.14", 80)), (2, 1, 6, "", ("10.0.0.1", 80))]

    monkeypatch.setattr(socket, "getaddrinfo", lambda *_: mixed)
    assert only(tmp_path, "http://mixed.example/x.jpg", allow_private=False).rejected == "private_address"


@pytest.mark.heavy
def test_a_silent_address_and_slow_names_cost_others_nothing(pictures, tmp_path, monkeypatch):
    """The first address of the host is a full queue; many names take longer than a picture may."""
    pictures.answers["/x.jpg"] = body(encoded(photo(1)))
    port, real = int(pictures.url.rpartition(":")[2]), socket.getaddrinfo

    def slow(host, *more):
        if host == "slow.example":
            time.sleep(2.0)
        return [*real("127.0.0.2", *more), *real("127.0.0.1", *more)] if host == "two.example" else real(host, *more)

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    with socket.socket() as hole, socket.socket() as one, socket.socket() as two:
        hole.bind(("127.0.0.2", port))
        hole.listen(0)
        for filler in (one, two):
            filler.setblocking(False)
            filler.connect_ex(("127.0.0.2", port))
        urls = [f"http://slow.example/{number}.jpg" for number in range(4)] + [f"http://two.example:{port}/x.jpg"]
        rows, _ = made(tmp_path, urls, FetchBounds(allow_private=True, timeout_s=1.0, parallel=2, per_host=4))
    assert [row.rejected for row in rows] == ["too_slow"] * 4 + [""]


@pytest.mark.heavy
def test_the_rest_of_a_dead_host_is_not_asked_and_the_next_run_asks_again(pictures, tmp_path):
    with socket.socket() as nobody:
        nobody.bind(("127.0.0.1", 0))
        dead = f"http://127.0.0.1:{nobody.getsockname()[1]}"
        rows, _ = made(tmp_path, [f"{dead}/{number}.jpg" for number in range(9)], replace(HERE, per_host=1))
    assert {row.rejected for row in rows} == {"unreachable"}
    assert ["not asked: 5 others" in row.rejected_detail for row in rows] == [False] * 5 + [True] * 4
    pictures.answers["/x.jpg"] = body(encoded(photo(1)))
    rows, _ = made(tmp_path, [f"{pictures.url}/x.jpg"])
    assert rows[0].rejected == ""


@pytest.mark.heavy
def test_redirects_to_one_host_count_as_requests_to_it(pictures, tmp_path, monkeypatch):
    def write(request, before):
        time.sleep(0.05)
        body(encoded(photo(1, (40, 30))))(request, before)

    real = socket.getaddrinfo
    monkeypatch.setattr(socket, "getaddrinfo", lambda _, *more: real("127.0.0.1", *more))
    pictures.answers |= {f"/{number}.jpg": write for number in range(8)}
    with picture_server() as other:
        other.answers = {f"/{number}": redirect(f"{pictures.url}/{number}.jpg") for number in range(8)}
        port = other.url.rpartition(":")[2]
        _, listed = made(tmp_path, [f"http://h{number}.example:{port}/{number}" for number in range(8)])
    assert listed.fetched == 8
    assert pictures.most == HERE.per_host


BAD_ROWS = {
    "bad_url": ("", "", ""),
    "bad_url scheme": ("ftp://example.org/a.jpg", "", ""),
    "bad_url file": ("file:///etc/passwd", "", ""),
    "bad_url none": ("=cmd|' /C calc'!A0", "", ""),
    "bad_url control": ("http://example.org/\x1b[2J\x00.jpg", "", ""),
    "bad_url secret": ("http://user:hush@example.org/a.jpg?hush", "", ""),
    "bad_url host": ("http:///a.jpg", "", ""),
    "bad_url port": ("http://127.0.0.1:99999/a.jpg", "", ""),
    "bad_url ipv6": ("http://[::1/user:hush@x.jpg", "", ""),
    "bad_url long": ("http://example.org/" + "x" * 1_000_000, "", ""),
    "bad_source": ("http://example.org/a.jpg", "x" * 1_000_000, ""),
    "bad_source licence": ("http://example.org/a.jpg", "", "x" * 1_000_000),
}


@pytest.mark.parametrize("suffix", ["csv", "jsonl", "parquet"])
def test_hostile_rows_are_rows_with_their_reason(tmp_path, suffix):
    rows = list(BAD_ROWS.values())
    path = tmp_path / f"list.{suffix}"
    columns = dict(zip(("URL", "source", "license"), zip(*rows, strict=True), strict=True))
    if suffix == "csv":
        with path.open("w", newline="") as file:
            csv.writer(file).writerows([columns, *rows])
    elif suffix == "jsonl":
        path.write_text("\n".join(json.dumps(dict(zip(columns, row, strict=True))) for row in rows))
    else:
        pq.write_table(pa.table(columns), path)
    listed = fetch_lists([str(path)], tmp_path / "pictures", HERE, BOUNDS)
    made_rows = make_manifest([], BOUNDS, listed).rows
    assert [row.rejected for row in made_rows] == [reason.partition(" ")[0] for reason in BAD_ROWS]
    for row in made_rows:
        assert "hush" not in row.model_dump_json()
        assert row.model_dump_json().isprintable()


@pytest.mark.heavy
def test_a_small_file_of_many_long_cells_is_refused_before_they_are_made(tmp_path):
    long = pa.DictionaryArray.from_arrays(pa.array(np.zeros(200_000, np.int32)), ["http://127.0.0.1/" + "a" * 4000])
    pq.write_table(pa.table({"url": long}), tmp_path / "list.parquet")
    assert (tmp_path / "list.parquet").stat().st_size < 1_000_000
    with pytest.raises(InputError, match="holds more than 536870912 bytes when unpacked"):
        read_list(str(tmp_path / "list.parquet"))


@pytest.mark.parametrize("urls", [[["a"], ["b"]], [{"a": 1}, {"a": 2}]])
def test_a_column_of_no_text_is_refused(tmp_path, urls):
    pq.write_table(pa.table({"url": urls}), tmp_path / "list.parquet")
    with pytest.raises(InputError, match="no one column url of text"):
        read_list(str(tmp_path / "list.parquet"))


def test_a_manifest_is_no_list(tmp_path):
    write_manifest(tmp_path / "m.parquet", make_manifest([], BOUNDS).rows)
    with pytest.raises(InputError, match="is a manifest already: give it to tableverse build"):
        read_list(str(tmp_path / "m.parquet"))


def test_what_is_no_text_in_a_list_is_a_row(tmp_path):
    path = tmp_path / "list.jsonl"
    path.write_text('{"url": 3}\n[1]\n{"url": "ftp://x", "licence": ["MIT"]}\nnonsense\n{"url": "ftp://x", "b": 1}\n')
    listed = fetch_lists([str(path)], tmp_path / "pictures", HERE, BOUNDS)
    reasons = [row.rejected for row in make_manifest([], BOUNDS, listed).rows]
    assert reasons == ["bad_url", "bad_list_row", "bad_source", "bad_list_row", "bad_url"]
    assert listed.ignored == {"column of list.jsonl: b": 1}


STRANGE = (
    "http://example.invalid/\ud800.jpg",
    "http://bücher.invalid/ä ö.jpg",
    "HTTP://EXAMPLE.invalid:99999/a.jpg",
    "http://example.invalid:0/a.jpg",
    "http://" + "a." * 300 + "invalid/a.jpg",
    "http://xn--.invalid/",
    "http://127.0.0.1%2f@example.invalid/",
    "http://１２７.0.0.1/",
    "http:\\\\127.0.0.1\\x",
    "//example.org/a.jpg",
    "http://user@@hush@127.0.0.1/hush@",
    "http://example.invalid/" + "%" * 300,
    "http://[fe80::1%25eth0]/x.jpg",
)


def test_strange_addresses_are_rows_with_a_reason(tmp_path, pictures):
    path = tmp_path / "list.jsonl"
    path.write_text("\n".join(json.dumps({"url": url, "source": "\ud800"}) for url in STRANGE))
    rows = make_manifest([], BOUNDS, fetch_lists([str(path)], tmp_path / "p", FetchBounds(timeout_s=5.0), BOUNDS)).rows
    assert {row.rejected for row in rows} <= {"bad_url", "private_address", "unreachable"}
    write_manifest(tmp_path / "m.parquet", rows)


@pytest.mark.heavy
def test_the_same_rows_come_out_in_whatever_order_downloads_end(pictures, tmp_path):
    def slow(seconds, data):
        def write(request, before):
            time.sleep(seconds)
            body(data)(request, before)

        return write

    data = [encoded(photo(number)) for number in (1, 1, 2)]
    urls = [f"{pictures.url}/{number}.jpg" for number in range(3)]
    found = []
    for run, waits in enumerate([(0.3, 0.0, 0.1), (0.0, 0.3, 0.1)]):
        folder = tmp_path / str(run)
        folder.mkdir()
        pictures.answers |= {
            f"/{n}.jpg": slow(wait, each) for n, (wait, each) in enumerate(zip(waits, data, strict=True))
        }
        rows, _ = made(folder, urls, FetchBounds(allow_private=True, per_host=3))
        found.append([row.model_dump() | {"uri": Path(row.uri).name, "rejected_detail": ""} for row in rows])
    assert found[0] == found[1]
    assert [row["rejected"] for row in found[0]] == ["", "duplicate_of", ""]


@pytest.mark.heavy
def test_a_host_is_asked_for_a_few_at_a_time(pictures, tmp_path):
    def write(request, before):
        time.sleep(0.02)
        body(encoded(photo(1, (40, 30))))(request, before)

    pictures.answers |= {f"/{number}.jpg": write for number in range(12)}
    made(tmp_path, [f"{pictures.url}/{number}.jpg" for number in range(12)], FetchBounds(allow_private=True))
    assert pictures.most == 2


def test_a_turned_photo_is_upright_for_all_that_follows(pictures, tmp_path):
    upright = photo(3)
    exif = Image.Exif()
    exif[0x0112] = 6
    lying = encoded(upright.transpose(Image.Transpose.ROTATE_90), "PNG", exif=exif)
    pictures.answers["/x.png"] = body(lying)
    row = only(tmp_path, f"{pictures.url}/x.png")
    assert np.array_equal(read_image(row.uri, BOUNDS), np.asarray(upright))
    (tmp_path / "disk").mkdir()
    (tmp_path / "disk" / "x.png").write_bytes(lying)
    assert np.array_equal(read_image(str(tmp_path / "disk" / "x.png"), BOUNDS), np.asarray(upright))


def test_near_duplicates_blur_and_the_rest_are_filtered_out(pictures, tmp_path):
    large, small = photo(1, (800, 600)), photo(1, (800, 600)).resize((400, 300))
    sent = {
        "small.jpg": small,
        "large.jpg": large,
        "blurred.jpg": photo(2).filter(ImageFilter.GaussianBlur(8)),
        "tiny.jpg": photo(3, (80, 60)),
        "long.jpg": photo(4, (1600, 300)),
        "flat.jpg": Image.new("RGB", (400, 300), "white"),
        "other.jpg": photo(5),
    }
    pictures.answers |= {f"/{name}": body(encoded(image, quality=70)) for name, image in sent.items()}
    rows, _ = made(tmp_path, [f"{pictures.url}/{name}" for name in sent], criteria=FilterCriteria())
    assert {row.name: row.rejected for row in rows} == {
        "small.jpg": "near_duplicate_of",
        "large.jpg": "",
        "blurred.jpg": "blurred",
        "tiny.jpg": "too_small",
        "long.jpg": "odd_shape",
        "flat.jpg": "uniform",
        "other.jpg": "",
    }
    assert rows[1].scene_id in rows[0].rejected_detail


def test_captures_are_never_filtered(tmp_path):
    write_capture(tmp_path / "c", 1)
    write_picture(tmp_path / "p" / "a.png", 2)
    rows = make_manifest([str(tmp_path)], BOUNDS, criteria=FilterCriteria()).rows
    assert [row.rejected for row in rows] == ["", "too_small"]


@pytest.mark.heavy
def test_a_long_list_costs_little(tmp_path):
    rows = [(f"http://example.org/{n}.jpg", "somewhere", "CC-BY-4.0") for n in range(10_000)]
    path = write_list(tmp_path / "list.csv", rows)
    began = time.process_time()
    assert len(read_list(str(path)).rows) == 10_000
    assert time.process_time() - began < 2


@pytest.mark.slow  # builds are killed in the fast run
@pytest.mark.heavy
def test_killed_and_run_again_fetches_only_the_rest(pictures, tmp_path):
    """Half of the pictures never come in the first run, which is killed while it waits for them."""
    sound = {f"/{number}.jpg": body(encoded(photo(number))) for number in range(8)}
    pictures.answers |= sound | {f"/{number}.jpg": drip for number in range(4, 8)}
    path = write_list(tmp_path / "list.csv", [(f"{pictures.url}/{n}.jpg", "", "") for n in range(8)])
    command = [sys.executable, "-c", "from tableverse_factory.cli.main import main; main()", "manifest", str(path)]
    command += ["--out", str(tmp_path / "m.parquet"), "--json", "--per-host", "4", "--allow-private"]
    running = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    until = time.monotonic() + 60
    index = tmp_path / "m-pictures" / "index.jsonl"
    while not index.exists() or len(index.read_bytes().splitlines()) < 4:
        assert time.monotonic() < until
        time.sleep(0.05)
    os.kill(running.pid, signal.SIGKILL)
    running.wait()
    assert not (tmp_path / "m.parquet").exists()
    pictures.answers |= sound
    again = subprocess.run(command, check=True, capture_output=True, text=True)
    told = json.loads(again.stdout)
    assert told == {"counts": {"image": {"accepted": 8}}, "ignored": {}, "fetched": {"now": 4, "earlier": 4}}
    assert all(pictures.asked[f"/{number}.jpg"] == 1 for number in range(4))


def test_the_command_says_what_came_and_what_did_not(run, pictures, tmp_path):
    pictures.answers["/a.jpg"] = body(encoded(photo(1)))
    path = write_list(tmp_path / "list.csv", [(f"{pictures.url}/{name}", "", "CC0-1.0") for name in ("a.jpg", "b.jpg")])
    code, out, _ = run("manifest", path, "--out", tmp_path / "m.parquet", "--allow-private")
    assert code == 0
    assert "fetched 1 picture; 0 were there already" in out
    assert "http_error: the server answers 404" in out
    assert pq.read_table(tmp_path / "m.parquet").column("licence").to_pylist() == ["CC0-1.0", "CC0-1.0"]
    for bound in ("--max-mb", "--timeout"):
        code, _, err = run("manifest", path, "--out", tmp_path / "n.parquet", bound, "inf")
        assert (code, err.count("\n")) == (1, 2)
    for options in (
        ["--pictures", tmp_path / "p"],
        ["--allow-private"],
        ["--max-mb", "1"],
        ["--no-filter", "--min-side", "3"],
    ):
        code, _, err = run("manifest", tmp_path, "--out", tmp_path / "n.parquet", *options)
        assert (code, err.count("\n")) == (1, 2)


@pytest.mark.parametrize(
    ("name", "content", "says"),
    [
        ("a.csv", b"", "has no column url: it has no columns"),
        ("a.csv", b"\xff\xfe\x00", "is no text in UTF-8"),
        ("a.csv", b"uri,kind\nx,y\n", "it has uri, kind"),
        ("a.csv", b"url;licence\nx;y\n", "a.csv has semicolons between its columns: give commas"),
        ("a.csv", b"url,URL\nx,y\n", "two columns for url"),
        ("a.jsonl", b'{"uri": "x"}\n', 'no line has a "url"'),
        ("a.parquet", b"PAR1", "is no Parquet file"),
    ],
)
def test_what_is_no_list_is_said_in_one_line(run, tmp_path, name, content, says):
    (tmp_path / name).write_bytes(content)
    code, _, err = run("manifest", tmp_path / name, "--out", tmp_path / "m.parquet")
    assert (code, err.count("\n")) == (1, 2)
    assert says in err
