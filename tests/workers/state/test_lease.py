"""One writer in a store: refused by name, taken over when it is silent, and it stops when it cannot be sure."""

import json
import time
from dataclasses import asdict

import pytest

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import get_store, list_names, parse_path, read_whole, remove, write_atomic
from workers.state import lease
from workers.state.lock import create_writer_lock, describe_writer
from workers.state.lock_owner import LockOwner, encode_owner, identify_process

pytestmark = pytest.mark.heavy


@pytest.fixture
def place(store, monkeypatch):
    """Where the lease lies; leases last four seconds here."""
    monkeypatch.setattr(lease, "LEASE_S", 4.0)
    monkeypatch.setattr(lease, "_SAFE_S", 2.5)
    monkeypatch.setattr(lease, "_HEARTBEAT_S", 0.3)
    monkeypatch.setattr(lease, "_POLL_S", 0.2)
    return store / ".work" / "lock"


def _foreign(pid: int = 4711) -> bytes:
    return encode_owner(LockOwner(pid, "elsewhere", "another world", 1), renewals=1)


def test_it_is_held_while_the_block_lasts_and_renewed(place):
    assert describe_writer(place) is None
    with create_writer_lock(place) as lock:
        before = json.loads(read_whole(place))["renewals"]
        time.sleep(1.0)
        lock.check()
        assert json.loads(read_whole(place))["renewals"] > before
        assert f"process {identify_process().pid}" in describe_writer(place)
    assert describe_writer(place) is None
    with create_writer_lock(place):
        pass


def test_the_second_is_refused_by_name(place):
    started = time.monotonic()
    with (
        create_writer_lock(place),
        pytest.raises(BuildError, match=rf"being written by process {identify_process().pid} on"),
    ):
        create_writer_lock(place).__enter__()
    assert time.monotonic() - started < 4.0, "a holder that renews is known before its lease could be over"


def test_a_silent_holder_elsewhere_is_waited_for_and_then_replaced(place):
    write_atomic(place, _foreign())
    assert "process 4711 on elsewhere" in describe_writer(place)
    started = time.monotonic()
    with create_writer_lock(place) as lock:
        assert 2.0 < time.monotonic() - started < 12.0
        lock.check()
        assert json.loads(read_whole(place))["pid"] == identify_process().pid


def test_a_dead_process_of_this_machine_is_replaced_at_once(place, monkeypatch):
    monkeypatch.setattr(lease, "LEASE_S", 1000.0)
    mine = asdict(identify_process())
    write_atomic(place, json.dumps({**mine, "started": mine["started"] + 1}).encode())
    started = time.monotonic()
    with create_writer_lock(place) as lock:
        assert time.monotonic() - started < 2.0
        lock.check()


def test_one_of_two_that_wait_gets_it(place):
    write_atomic(place, _foreign())
    fs, etag = get_store(place), get_store(place).head_and_get(place.path).etag
    took = [fs.put_if_match(place.path, _foreign(pid), etag) for pid in (1, 2)]
    assert [etag is not None for etag in took] == [True, False]


@pytest.mark.parametrize("how", ["replaced", "removed"])
def test_a_holder_that_lost_it_stops_and_leaves_the_other_alone(place, how):
    with create_writer_lock(place) as lock:
        lock.check()
        write_atomic(place, _foreign()) if how == "replaced" else remove(place)
        time.sleep(1.0)
        with pytest.raises(BuildError, match="has lost the right to write it"):
            lock.check()
    assert (describe_writer(place) is not None) == (how == "replaced")


def test_a_holder_that_cannot_renew_stops_before_the_lease_is_over(place, proxy):
    place = parse_path(str(place))  # again: the other one knows the way without the proxy
    list_names(place.parent)  # the first call makes the client, which takes its time
    with create_writer_lock(place) as lock:
        proxy.fault = lambda method, path: "refused"
        lock.check()
        time.sleep(0.8 * lease.LEASE_S)
        with pytest.raises(BuildError, match="lost the right"):
            lock.check()
        proxy.fault = lambda method, path: None


def test_a_store_that_ignores_conditions_is_refused(place, proxy):
    proxy.deaf_to = frozenset({"if-none-match", "if-match"})
    place = parse_path(str(place))
    with pytest.raises(BuildError, match="writes without looking at conditions"):
        create_writer_lock(place).__enter__()
    assert list_names(place.parent) == []


def test_what_waits_for_another_attempt_is_ended_with_the_lease(place, proxy):
    """Else it could be written a minute later, when somebody else has the dataset."""
    place = parse_path(str(place))
    list_names(place.parent)
    proxy.silence_s = 10.0
    with create_writer_lock(place):
        proxy.fault = lambda method, path: "silent" if method in ("PUT", "DELETE") else None
        started = time.monotonic()
        with pytest.raises(BuildError, match="the right to write was lost"):
            write_atomic(place.parent / "x", b"late")
        assert time.monotonic() - started < lease.LEASE_S + 1.0
        proxy.fault = lambda method, path: None
        time.sleep(1.5)
    assert "x" not in list_names(place.parent)
