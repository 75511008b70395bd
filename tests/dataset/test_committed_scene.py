"""A real exported scene, at rest and read back, is the record that it was: byte for byte, as far as records go."""

from pathlib import Path

import pytest

from schemas.codec import decode, encode
from schemas.scene import ExportedScene
from schemas.tables import OBJECTS, SCENES, TASKS
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.committed_scene import ADDED_BY_COMMIT, load_exported_scene
from tableverse_factory.dataset.shards import TarShard, check_exported, shard_path
from tests.helpers.photographed_scene import box_and_ball


@pytest.fixture(scope="module", params=["photographed", "layout"])
def scene(request) -> ExportedScene:
    return box_and_ball(request.param == "photographed")


@pytest.fixture
def out(scene, tmp_path) -> Path:
    """A dataset of the one scene, with what a commit adds to its row."""
    tar_path = shard_path(tmp_path, "mjcf", 0)
    tar_path.parent.mkdir(parents=True)
    with tar_path.open("wb") as file:
        tar = TarShard(file)
        offset, size = tar.add(scene)
        tar.close()
    added = {"kind": "layout", "uri": "/x", "status": "done", "stage": "export", "attempts": 2, "n_trajectories": 3}
    row = {**scene.scene_row, **added, "shard": 0, "tar_offset": offset, "tar_size": size}
    for name, rows, schema in (
        ("scenes", [row], SCENES),
        ("objects", scene.object_rows, OBJECTS),
        ("tasks", scene.task_rows, TASKS),
    ):
        write_atomic(shard_path(tmp_path, name, 0), encode_parquet(build_table(rows, schema)))
    return tmp_path


def test_reading_back_is_the_inverse_of_writing(scene, out):
    read = load_exported_scene(out, 0, scene.scene_id)
    assert read is not None
    check_exported(read, scene.scene_id)
    assert encode(read) == encode(scene)
    assert encode(decode(encode(scene))) == encode(scene)
    assert not ADDED_BY_COMMIT & {name for name, value in read.scene_row.items() if value is not None}


def test_a_shard_is_read_once_for_all_of_its_scenes_and_again_when_it_was_written_again(scene, out):
    assert load_exported_scene(out, 0, scene.scene_id) is not None
    objects, scenes = (shard_path(out, name, 0) for name in ("objects", "scenes"))
    objects.write_bytes(b"not looked at, while the table of scenes is the same file")
    assert encode(load_exported_scene(out, 0, scene.scene_id)) == encode(scene)
    write_atomic(scenes, scenes.read_bytes())
    with pytest.raises(BuildError, match=r"shard-00000\.parquet is damaged"):
        load_exported_scene(out, 0, scene.scene_id)


def test_what_is_not_there_is_nothing_and_what_is_damaged_is_said(scene, out):
    assert load_exported_scene(out, 0, "another") is None
    assert load_exported_scene(out, 1, scene.scene_id) is None
    tar = shard_path(out, "mjcf", 0)
    whole = tar.read_bytes()
    tar.write_bytes(whole[:3000])
    with pytest.raises(BuildError, match=r"shard-00000\.tar is damaged .*cut short.*delete scenes/"):
        load_exported_scene(out, 0, scene.scene_id)
    tar.write_bytes(bytes(len(whole)))
    with pytest.raises(BuildError, match=r"shard-00000\.tar is damaged"):
        load_exported_scene(out, 0, scene.scene_id)
