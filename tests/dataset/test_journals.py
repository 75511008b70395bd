"""Journals of a dataset from elsewhere: what no build wrote is refused, and no other file is read."""

import threading
import time
from dataclasses import replace

import pytest

from schemas.codec import encode
from schemas.manifest import ImageRow, SceneKind
from schemas.work import ScenePart, SceneResult
from tableverse_factory import open_dataset
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.framing import encode_header
from tableverse_factory.dataset.journals import (
    RESULT,
    find_journal_end,
    journal_path,
    read_journal,
    read_result,
    read_results,
)
from workers.state.journal import open_journal

ROW = ImageRow(scene_id="a-1", kind=SceneKind.CAPTURE, uri="/x")
PART = ScenePart("0.parts", 0, 1000, 1000)
DONE = SceneResult(ROW, "done", "export", part=PART)


@pytest.mark.parametrize(
    "payload",
    [
        b"no record",
        encode(7),
        encode(replace(DONE, row=7)),
        encode(replace(DONE, status="well")),
        encode(replace(DONE, timings=(3,))),
        encode(replace(DONE, costs=((1, 2),))),
        encode(replace(DONE, part=replace(PART, file="/dev/zero"))),
        encode(replace(DONE, part=replace(PART, file="../../secret.parts"))),
        encode(replace(DONE, part=replace(PART, file=""))),
        encode(replace(DONE, part=replace(PART, file="0.parts\0"))),
        encode(replace(DONE, part=replace(PART, offset=-1))),
        encode(replace(DONE, part=replace(PART, files_size="many"))),
    ],
)
def test_a_frame_that_is_no_result_is_refused_in_one_line(tmp_path, payload):
    path = journal_path(tmp_path, 0)
    path.parent.mkdir()
    path.write_bytes(encode_header(payload, RESULT + b"a-1") + payload)
    (tmp_path / "run.json").write_text("{}")
    with pytest.raises(
        BuildError, match=r"shard-00000\.journal is no journal of a build \([^\n]*: delete it"
    ) as refused:
        open_dataset(tmp_path).scenes.to_table()
    assert len(str(refused.value)) < 1000
    with pytest.raises(BuildError, match="delete it"):
        read_result(path, read_journal(path).results["a-1"])


@pytest.mark.heavy
@pytest.mark.parametrize("place", ["tmp_path", "store"])
def test_a_journal_that_goes_while_it_is_read_counts_as_missing(place, request):
    """Shards are committed, and their journals removed, while others read the dataset."""
    path, ended = journal_path(request.getfixturevalue(place), 0), threading.Event()

    def write() -> None:
        while not ended.is_set():
            journal = open_journal(path)
            journal.record(replace(DONE, part=None))
            journal.flush()
            journal.remove()

    writer = threading.Thread(target=write)
    writer.start()
    try:
        until = time.monotonic() + 2.0
        while time.monotonic() < until:
            assert read_results(path).keys() | read_journal(path).results.keys() <= {"a-1"}
            assert find_journal_end(path) >= 0
    finally:
        ended.set()
        writer.join()
