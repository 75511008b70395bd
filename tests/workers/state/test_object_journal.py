"""A journal of objects keeps what a file would keep, a second later at the most."""

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from schemas.manifest import ImageRow, SceneKind
from schemas.work import SceneResult, StageTiming
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import list_names, read_whole, write_atomic
from tableverse_factory.dataset.journals import find_journal_end, read_journal, read_result, read_results
from workers.state import journal as journal_module
from workers.state.journal import open_journal

pytestmark = pytest.mark.heavy


def _result(scene_id: str, detail: str = "why") -> SceneResult:
    row = ImageRow(scene_id=scene_id, kind=SceneKind.CAPTURE, uri="/x")
    return SceneResult(row, "failed", "export", "", "crash", detail, 1, (StageTiming("cut", 0.5, 0.6),))


@settings(max_examples=15, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    steps=st.lists(
        st.tuples(st.sampled_from(["record", "reopen", "flush", "restart"]), st.sampled_from("abc")), max_size=12
    )
)
def test_it_says_what_a_file_says(store, tmp_path_factory, steps):
    """Any history, with restarts and flushes anywhere: the same results, and the same places in the journal."""
    folder = tmp_path_factory.mktemp("journal")
    here, there = folder / "j", store / folder.name
    ours, theirs = open_journal(here), open_journal(there)
    for number, (what, scene_id) in enumerate(steps):
        for journal in (ours, theirs):
            if what == "record":
                journal.record(_result(scene_id, str(number) * 100))
            elif what == "reopen":
                journal.reopen(scene_id)
            else:
                journal.close()
        if what in ("restart", "flush"):
            ours = open_journal(here)
        if what == "restart":
            theirs = open_journal(there)
    ours.close()
    theirs.close()
    local, remote = read_journal(here), read_journal(there)
    assert {k: (e.offset, e.size) for k, e in local.results.items()} == {
        k: (e.offset, e.size) for k, e in remote.results.items()
    }
    assert (local.reopened, local.end) == (remote.reopened, remote.end)
    assert find_journal_end(here) == find_journal_end(there) == local.end
    assert read_results(here) == read_results(there)
    assert read_results(there) == {k: read_result(there, e) for k, e in remote.results.items()}


def test_results_wait_for_a_second_or_for_eight_megabytes(store, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(journal_module.time, "monotonic", lambda: now[0])
    journal = open_journal(store / "j")
    journal.record(_result("a"))
    journal.tick()
    assert list_names(store / "j") == []
    now[0] += 0.6
    journal.record(_result("b"))
    now[0] += 0.5
    journal.tick()
    assert set(read_journal(store / "j").results) == {"a", "b"}, "the oldest has waited a second"
    journal.record(_result("c", "x" * 9_000_000))
    assert set(read_journal(store / "j").results) == {"a", "b", "c"}
    assert len(list_names(store / "j")) == 2
    journal.record(_result("d"))
    assert read_journal(store / "j").results.keys() == {"a", "b", "c"}, "a kill now costs d"


def test_a_later_look_reads_what_is_new_alone(store):
    journal = open_journal(store / "j")
    journal.record(_result("a"))
    journal.close()
    first = read_journal(store / "j")
    journal.record(_result("b"))
    journal.close()
    assert set(read_journal(store / "j", first.end).results) == {"b"}
    assert read_journal(store / "j", find_journal_end(store / "j")).results == {}


def test_a_damaged_object_costs_its_own_results_alone(store):
    journal = open_journal(store / "j")
    for name in "abc":
        journal.record(_result(name))
        journal.close()
    middle = store / "j" / list_names(store / "j")[1]
    data = bytearray(read_whole(middle))
    data[-1] ^= 1
    write_atomic(middle, bytes(data))
    assert read_journal(store / "j").lost == len(data)
    again = open_journal(store / "j")
    assert set(read_results(store / "j")) == {"a", "c"}
    again.record(_result("b"))
    again.close()
    assert read_results(store / "j") == {name: _result(name) for name in "abc"}


def test_two_writers_are_noticed_and_the_first_to_write_wins(store):
    first, second = open_journal(store / "j"), open_journal(store / "j")
    first.record(_result("a"))
    first.close()
    second.record(_result("b"))
    with pytest.raises(BuildError, match="written by another process"):
        second.close()
    assert set(read_journal(store / "j").results) == {"a"}
