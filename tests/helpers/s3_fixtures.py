"""A bucket of its own for every test, on a real server of the S3 protocol that all of them share."""

import itertools
from collections.abc import Iterator

import pytest

from tableverse_factory.core.storage.files import StoragePath, get_store, parse_path
from tableverse_factory.core.storage.s3 import ObjectStore
from tests.helpers.faulty_proxy import FaultyProxy, faulty_proxy
from tests.helpers.s3_server import s3_server

_NUMBERS = itertools.count()


@pytest.fixture(scope="session")
def endpoint() -> Iterator[str]:
    with s3_server() as address:
        yield address


@pytest.fixture
def store(endpoint, monkeypatch) -> StoragePath:
    """A prefix in a new bucket."""
    monkeypatch.setenv("AWS_ENDPOINT_URL", endpoint)
    for name, value in (("ACCESS_KEY_ID", "test"), ("SECRET_ACCESS_KEY", "test"), ("DEFAULT_REGION", "us-east-1")):
        monkeypatch.setenv(f"AWS_{name}", value)
    ObjectStore.clear_instance_cache()  # they keep the endpoint that they were made with
    place = parse_path(f"s3://bucket-{next(_NUMBERS)}/some/prefix")
    get_store(place).call_s3("create_bucket", Bucket=place.path.partition("/")[0])
    return place


@pytest.fixture
def proxy(store, endpoint, monkeypatch) -> Iterator[FaultyProxy]:
    """From now on the store is reached through a proxy that fails on purpose; the client gives up sooner than usual."""
    with faulty_proxy(endpoint) as running:
        monkeypatch.setenv("AWS_ENDPOINT_URL", running.endpoint)
        monkeypatch.setattr(ObjectStore, "read_timeout", 1)
        ObjectStore.clear_instance_cache()
        yield running
    ObjectStore.clear_instance_cache()
