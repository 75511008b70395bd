"""A dataset is read while it grows: scenes are there as soon as they end, and stay what they were."""

import json
import signal
from dataclasses import replace

import pyarrow.compute as pc
import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.dataset.journals import WORK, journal_path, read_journal
from tests.helpers.builds import Silent, build, digests, finish, kill, request, start, wait_until, write_manifest
from workers.run import run_build

pytestmark = pytest.mark.heavy

NAMES = ["fine", "empty", "fine", "raise", "fine", "fine", "fine", "fine", "fine", "fine"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A manifest and its dataset, in shards of four."""
    folder = tmp_path_factory.mktemp("whole")
    manifest = write_manifest(folder / "m.parquet", NAMES)
    build(manifest, folder / "out")
    return manifest, folder / "out"


def test_scenes_are_there_before_their_shard_is(whole, tmp_path):
    manifest, finished = whole
    run_build(replace(request(manifest, tmp_path / "out"), limit=6), Silent())
    growing, final = open_dataset(tmp_path / "out"), open_dataset(finished)
    assert growing.shards == (0,)
    rows = growing.scenes.to_table().to_pylist()
    assert [row["scene_id"] for row in rows] == [f"scene_{i:03d}" for i in range(6)]
    for row in rows:
        known = final.scene_row(row["scene_id"])
        assert {**row, "tar_offset": 0} == {**known, "tar_offset": 0 if row["status"] == "done" else None} or (
            row["status"] != "done" and row == known
        )
        if row["status"] == "done":
            ours, theirs = growing.scene(row["scene_id"]), final.scene(row["scene_id"])
            assert ours.files() == theirs.files()
            assert ours.object_rows() == theirs.object_rows()
    assert [row["tar_offset"] for row in rows[4:]] == [-1, -1]
    assert growing.objects.count_rows() == final.objects.filter(pc.field("scene_id") < "scene_006").count_rows()
    with pytest.raises(InputError, match="no scene"):
        growing.scene("scene_099")
    with pytest.raises(InputError, match="scene_009 is planned and not there yet"):
        growing.scene("scene_009")


def test_a_scene_that_moves_to_its_shard_while_it_is_looked_at_is_found_there(whole, tmp_path):
    manifest, finished = whole
    run_build(replace(request(manifest, tmp_path / "out"), limit=6), Silent())
    before = open_dataset(tmp_path / "out")
    row = before.scene_row("scene_005")
    build(manifest, tmp_path / "out")
    assert before.scene_at(row).files() == open_dataset(finished).scene("scene_005").files()
    assert digests(tmp_path / "out") == digests(finished)


@pytest.mark.parametrize("how", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.slow)])
def test_what_is_done_can_be_read_after_any_stop(tmp_path, how):
    manifest = write_manifest(tmp_path / "m.parquet", ["slow_0.1"] * 30)
    process = start(manifest, tmp_path / "out", shard_size=64)
    wait_until(lambda: read_journal(journal_path(tmp_path / "out", 0)).results)
    if how == signal.SIGKILL:
        kill(process)
    else:
        process.send_signal(how)
        finish(process)
    growing = open_dataset(tmp_path / "out")
    done = growing.scenes.to_table(filter=pc.field("status") == "done")["scene_id"].to_pylist()
    assert done
    assert growing.shards == ()
    for scene_id in done:
        assert "scene.xml" in growing.scene(scene_id).files()


@pytest.mark.parametrize(
    "damage", ["torn", *(pytest.param(damage, marks=pytest.mark.slow) for damage in ("flipped", "gone"))]
)
def test_parts_that_a_loss_of_power_took_are_named_and_made_again(whole, tmp_path, damage, run):
    manifest, finished = whole
    out = tmp_path / "out"
    run_build(replace(request(manifest, out), limit=6), Silent())
    (parts,) = (out / WORK / "shard-00001.parts").iterdir()
    if damage == "gone":
        parts.unlink()
    else:
        data = bytearray(parts.read_bytes())
        data[len(data) // 2] ^= 1
        parts.write_bytes(data if damage == "flipped" else data[: len(data) // 2])
    assert open_dataset(out).scenes.count_rows() >= 4, "the others are still read"
    code, said, _ = run("status", out, "--json")
    cut = {"torn": ["scene_005"], "flipped": [], "gone": ["scene_004", "scene_005"]}[damage]
    assert (code, json.loads(said)["damaged"]) == (0, cut), "all but what only its checksum tells"
    assert ("damaged, as by a loss of power: " in run("status", out)[1]) == bool(cut)
    display = Silent()
    summary = run_build(request(manifest, out), display)
    assert summary.tally.accounted == len(NAMES), "no scene counts twice"
    assert [note for note in display.notes if "finished scenes do not read" in note]
    assert digests(out) == digests(finished)


def test_no_file_is_left_of_what_was_provisional(whole, tmp_path):
    manifest, _ = whole
    out = tmp_path / "out"
    run_build(replace(request(manifest, out), limit=9), Silent())
    left = {path.name for path in (out / WORK).iterdir()} - {"lock"}
    assert left == {"shard-00002.journal", "shard-00002.parts"}, "committed shards have left nothing"
    build(manifest, out)
    assert not (out / WORK).exists()
