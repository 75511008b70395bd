"""A journal keeps what was recorded, whatever happens to its tail."""

import os
import subprocess
import sys
from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.manifest import ImageRow, SceneKind
from schemas.work import SceneResult, StageTiming
from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset.journals import read_journal, read_result, read_results
from tests.helpers.builds import Silent, build, digests, request, write_manifest
from workers.run import run_build
from workers.state.journal import FileJournal


def _result(scene_id: str, detail: str = "why") -> SceneResult:
    row = ImageRow(scene_id=scene_id, kind=SceneKind.CAPTURE, uri="/x")
    return SceneResult(row, "failed", "export", "", "crash", detail, 1, (StageTiming("cut", 0.5, 0.6),))


def test_what_is_recorded_is_read_back(tmp_path):
    journal = FileJournal(tmp_path / "j")
    for name in ("a", "b", "c"):
        journal.record(_result(name, name * 1000))
    journal.close()
    assert read_results(tmp_path / "j") == {name: _result(name, name * 1000) for name in ("a", "b", "c")}


@pytest.mark.heavy
@given(cut=st.integers(0, 2000))
def test_a_torn_tail_costs_only_what_was_torn(tmp_path_factory, cut):
    path = tmp_path_factory.mktemp("journal") / "j"
    journal = FileJournal(path)
    ends = []
    for name in ("a", "b", "c"):
        journal.record(_result(name))
        ends.append(path.stat().st_size)
    journal.close()
    cut = min(cut, ends[-1])
    os.truncate(path, cut)
    whole = [name for name, end in zip("abc", ends, strict=True) if end <= cut]
    again = FileJournal(path)
    assert sorted(read_results(path)) == whole
    again.record(_result("d"))
    again.close()
    assert sorted(read_journal(path).results) == [*whole, "d"]
    assert read_result(path, read_journal(path).results["d"]) == _result("d")


@pytest.mark.heavy
@given(at=st.integers(0, 2000), bit=st.integers(0, 7))
def test_a_flipped_bit_is_never_believed(tmp_path_factory, at, bit):
    path = tmp_path_factory.mktemp("journal") / "j"
    journal = FileJournal(path)
    journal.record(_result("a"))
    journal.record(_result("b"))
    journal.close()
    data = bytearray(path.read_bytes())
    data[at % len(data)] ^= 1 << bit
    path.write_bytes(data)
    contents = read_journal(path)
    for name, entry in contents.results.items():
        assert read_result(path, entry) == _result(name)


def test_a_reopened_scene_is_to_do_until_it_has_a_new_result(tmp_path):
    journal = FileJournal(tmp_path / "j")
    journal.record(_result("a", "old"))
    journal.record(_result("b"))
    journal.reopen("a")
    journal.close()
    contents = read_journal(tmp_path / "j")
    assert (set(contents.results), contents.reopened) == ({"b"}, {"a"})
    assert set(read_results(tmp_path / "j")) == {"b"}
    again = FileJournal(tmp_path / "j")
    again.record(_result("a"))
    assert read_results(tmp_path / "j") == {"a": _result("a"), "b": _result("b")}
    assert read_journal(tmp_path / "j").reopened == {"a"}


@pytest.mark.heavy
def test_a_full_disk_is_a_clear_error_and_loses_nothing(tmp_path):
    """The limit on file size stands for the disk: `ulimit -f`, in a process of its own."""
    script = f"""
import resource, signal
from pathlib import Path
from schemas.manifest import ImageRow, SceneKind
from schemas.work import SceneResult
from tableverse_factory.core.errors import BuildError
from workers.state.journal import FileJournal
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
journal = FileJournal(Path({str(tmp_path / "j")!r}))
row = lambda name: ImageRow(scene_id=name, kind=SceneKind.CAPTURE, uri="/x")
result = lambda name, detail: SceneResult(row(name), "failed", "export", "", "", detail)
journal.record(result("a", "x" * 10_000))
try:
    journal.record(result("b", "x" * 50_000))
except BuildError as error:
    print(error)
journal.record(result("c", "x" * 100))
"""
    ran = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert "run the same command to go on" in ran.stdout
    assert set(read_journal(tmp_path / "j").results) == {"a", "c"}


def test_a_folder_that_refuses_is_a_clear_error(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(BuildError, match="cannot write"):
        FileJournal(tmp_path / "file" / "j")


@pytest.mark.heavy
def test_a_damaged_journal_is_said_and_costs_what_stood_there_alone(tmp_path):
    manifest = write_manifest(tmp_path / "m.parquet", ["fine"] * 3)
    build(manifest, tmp_path / "whole")
    half = replace(request(manifest, tmp_path / "out"), limit=2)
    run_build(half, Silent())
    path = tmp_path / "out" / ".work" / "shard-00000.journal"
    data = bytearray(path.read_bytes())
    data[100] ^= 1
    path.write_bytes(data)
    display = Silent()
    assert run_build(replace(half, limit=None), display).tally.before == 0
    notes = [note for note in display.notes if str(path) in note]
    assert len(notes) == 1
    assert f"{len(data)} bytes hold no whole result" in notes[0]
    assert digests(tmp_path / "out") == digests(tmp_path / "whole")


def test_a_journal_that_cannot_be_read_is_a_clear_error(tmp_path):
    (tmp_path / "j").mkdir()
    with pytest.raises(BuildError, match=r"cannot read .*j: Is a directory: mend the disk"):
        FileJournal(tmp_path / "j")


def test_a_journal_that_does_not_close_is_a_clear_error(tmp_path):
    journal = FileJournal(tmp_path / "j")
    os.close(journal._file.fileno())  # a network disk reports its failures when a file is closed, as this one now
    with pytest.raises(BuildError, match=r"cannot write .*j: Bad file descriptor"):
        journal.close()


def test_a_journal_that_cannot_be_removed_is_a_clear_error(tmp_path):
    journal = FileJournal(tmp_path / "j")
    (tmp_path / "j").unlink()
    with pytest.raises(BuildError, match=r"cannot write .*j: No such file"):
        journal.remove()
