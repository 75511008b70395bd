"""Storage paths that users give, and files that are whole or absent in a store."""

import sys

import pytest
from upath import UPath

from tableverse_factory.core.errors import BuildError, InputError, StoreError
from tableverse_factory.core.storage import files
from tableverse_factory.core.storage.files import (
    abort_uploads,
    atomic_file,
    get_store,
    list_names,
    parse_path,
    read_range,
    read_whole,
    redact_uri,
    remove_folder,
    write_atomic,
)
from tableverse_factory.core.storage.s3 import ObjectStore

pytestmark = pytest.mark.heavy


@pytest.mark.parametrize(
    ("text", "meant"),
    [
        ("out", "out"),
        ("/data/out", "/data/out"),
        ("file:///data/out", "/data/out"),
        ("odd:name", "odd:name"),
        ("s3://bucket", "s3://bucket/"),
        ("s3://bucket/", "s3://bucket/"),
        ("s3://bucket/a/b/", "s3://bucket/a/b"),
        ("s3://my.bucket-1/scènes", "s3://my.bucket-1/scènes"),
    ],
)
def test_a_place_is_what_was_typed(text, meant):
    place = parse_path(text)
    assert str(place) == meant
    assert isinstance(place, UPath) == text.startswith("s3://")


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("gs://bucket/x", "gs:// is no place for this: give a path, or s3://bucket/prefix"),
        ("http://host/x", "http:// is no place"),
        ("file://host/x", "file:// is no place"),
        ("s3://", "is no name of a bucket"),
        ("s3://ab", "is no name of a bucket"),
        ("s3://buck et/x", "is no name of a bucket"),
        ("s3://key:sec@ret@bucket/x", "AWS_"),
        ("s3://bucket/x?versionId=secret", "AWS_"),
        ("s3://bucket/x#secret", "AWS_"),
        ("s3://bucket/a/../b", "no dots alone"),
        ("s3://bucket//a", "no empty part"),
        ("s3://bucket/a\nb", "printable"),
        ("s3://bucket/" + "a" * 2000, "at most 1024"),
    ],
)
def test_what_is_no_place_is_refused_without_repeating_a_secret(text, why):
    with pytest.raises(InputError, match=why) as refused:
        parse_path(text)
    assert "sec" not in str(refused.value)


def test_without_s3fs_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "s3fs", None)
    monkeypatch.setattr(files.importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"pip install 'tableverse-factory\[s3\]'"):
        parse_path("s3://bucket/x")


def test_addresses_in_messages_hold_no_secrets():
    assert redact_uri("https://user:pa@ss@host/x.png?X-Amz-Signature=abc") == "https://host/x.png"
    assert redact_uri("/data/what?.png") == "/data/what?.png"


def test_a_file_appears_whole_or_not_at_all(store):
    big = bytes(range(256)) * 100_000  # two parts
    with atomic_file(store / "big") as file:
        file.write(big)
        assert list_names(store) == []
    with pytest.raises(ZeroDivisionError), atomic_file(store / "big") as file:
        file.write(big[::-1][: len(big) // (len(list_names(store)) - 1)])
    assert read_whole(store / "big") == big
    assert read_range(store / "big", 1000, 50) == big[1000:1050]
    assert read_range(store / "big", len(big) - 3, 50) == big[-3:]
    with atomic_file(store / "empty"):
        pass
    assert read_whole(store / "empty") == b""
    bucket = store.path.partition("/")[0]
    assert not get_store(store).call_s3("list_multipart_uploads", Bucket=bucket).get("Uploads")


def test_abandoned_uploads_are_aborted_below_the_prefix_alone(store):
    fs = get_store(store)
    bucket, _, key = store.path.partition("/")
    for name in (f"{key}/mjcf/a.tar", f"{key}/.work/x", f"{key}-other/a.tar"):
        upload = fs.call_s3("create_multipart_upload", Bucket=bucket, Key=name)
        fs.call_s3(
            "upload_part", Bucket=bucket, Key=name, UploadId=upload["UploadId"], PartNumber=1, Body=b"x" * 6_000_000
        )
    abort_uploads(store)
    left = fs.call_s3("list_multipart_uploads", Bucket=bucket)["Uploads"]
    assert [upload["Key"] for upload in left] == [f"{key}-other/a.tar"]


def test_a_folder_is_removed_with_all_that_is_below_it_and_nothing_else(store):
    for name in ("a/b/c", "a/d", "a/keep", "a.txt", "ab/c"):
        write_atomic(store / name, b"x")
    remove_folder(store / "a", keep="keep")
    assert list_names(store / "a") == ["keep"]
    remove_folder(store / "a")
    remove_folder(store / "a")
    assert list_names(store) == ["a.txt", "ab"]
    bucket = parse_path(f"s3://{store.path.partition('/')[0]}")
    assert list_names(bucket) == ["some"]


def test_writes_under_a_condition(store):
    fs, path = get_store(store), (store / "x").path
    first = fs.put_if_absent(path, b"1")
    assert first is not None
    assert fs.put_if_absent(path, b"1") == first, "an answer that was lost is no refusal"
    assert fs.put_if_absent(path, b"2") is None
    second = fs.put_if_match(path, b"2", first)
    assert fs.put_if_match(path, b"3", first) is None
    assert fs.head_and_get(path).data == b"2"
    assert fs.head_and_get(path).etag == second
    assert 0.0 <= fs.head_and_get(path).age_s < 5.0
    assert fs.head_and_get((store / "none").path) is None


def test_what_a_store_refuses_says_what_to_do(store, monkeypatch):
    missing = parse_path("s3://no-such-bucket/x")
    for failing in (
        lambda: write_atomic(missing / "x", b""),
        lambda: read_whole(missing / "x"),
        lambda: list_names(missing),
    ):
        with pytest.raises(BuildError, match=r"s3://no-such-bucket.*there is no bucket no-such-bucket: make it"):
            failing()
    with pytest.raises(FileNotFoundError):
        read_whole(store / "none")
    for name in ("AWS_ACCESS_KEY_ID", "AWS_SECRET_ACCESS_KEY"):
        monkeypatch.delenv(name)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("AWS_CONFIG_FILE", "/nonexistent")
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", "/nonexistent")
    ObjectStore.clear_instance_cache()
    with pytest.raises(StoreError, match="no credentials: set AWS_ACCESS_KEY_ID"):
        list_names(parse_path(str(store)))


def test_denied_access_is_said_at_once(store, proxy):
    proxy.fault = lambda method, path: "denied"
    place = parse_path(str(store))
    for failing in (lambda: list_names(place), lambda: read_whole(place / "x"), lambda: (place / "x").exists()):
        proxy.passed.clear()
        with pytest.raises(StoreError, match=r"access denied \((AccessDenied|403)\): see docs/storage\.md"):
            failing()
        assert len(proxy.passed) == 1, "another attempt would be denied too"
    with pytest.raises(BuildError, match="access denied"):
        write_atomic(place / "x", b"")
