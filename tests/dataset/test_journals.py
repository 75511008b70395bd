"""Journals of a dataset from elsewhere: what no build wrote is refused, and no other file is read."""

from dataclasses import replace

import pytest

from schemas.codec import encode
from schemas.manifest import ImageRow, SceneKind
from schemas.work import ScenePart, SceneResult
from tableverse_factory import open_dataset
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.framing import encode_header
from tableverse_factory.dataset.journals import RESULT, journal_path, read_journal, read_result

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
