"""A part gives back what was written, or says that it does not."""

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from schemas.codec import encode
from schemas.work import ScenePart
from tableverse_factory.core.framing import FrameError, encode_header
from tableverse_factory.dataset.parts import PartWriter, parts_folder, read_part_files, read_part_rows
from tableverse_factory.dataset.tar_members import read_scene_files
from tableverse_factory.evaluation.bench.noop_pipeline import make_minimal_scene


def test_scenes_of_one_process_share_a_file_and_are_read_apart(tmp_path):
    writer = PartWriter(tmp_path)
    scenes = [make_minimal_scene(f"s-{i}") for i in range(3)]
    parts = [writer.write(0, scene) for scene in scenes]
    assert len(list(parts_folder(tmp_path, 0).iterdir())) == 1
    for scene, part in zip(scenes, parts, strict=True):
        rows = read_part_rows(tmp_path, 0, part)
        assert rows["scenes"] == [scene.scene_row]
        assert rows["objects"] == list(scene.object_rows)
        assert read_scene_files(scene.scene_id, read_part_files(tmp_path, 0, part)) == dict(scene.files)


def test_a_part_in_a_store_is_an_object(store):
    scene = make_minimal_scene("s-0")
    part = PartWriter(store).write(7, scene)
    assert read_part_rows(store, 7, part)["tasks"] == list(scene.task_rows)
    assert read_scene_files("s-0", read_part_files(store, 7, part)) == dict(scene.files)


@pytest.mark.heavy
@given(at=st.integers(0, 10**6), bit=st.integers(0, 7))
def test_a_flipped_bit_is_never_believed(tmp_path_factory, at, bit):
    out, scene = tmp_path_factory.mktemp("parts"), make_minimal_scene("s-0")
    part = PartWriter(out).write(0, scene)
    path = parts_folder(out, 0) / part.file
    data = bytearray(path.read_bytes())
    data[at % len(data)] ^= 1 << bit
    path.write_bytes(data)
    with pytest.raises(FrameError):  # noqa: PT012 either of them
        read_part_rows(out, 0, part)
        read_part_files(out, 0, part)


@pytest.mark.parametrize(
    "tables",
    [
        (3, 4, 5, 6),
        ((), (), ()),
        ((), (), (), ()),
        (({}, {}), (), (), ()),
        ((3,), (), (), ()),
        (({"n_objects": "many"},), (), (), ()),
        (({"n_objects": 10**30},), (), (), ()),
        (({"mesh_licences": 5},), (), (), ()),
        (({},), ({"mass_kg": {"a": 1}},), (), ()),
        (({},), (), ({"no_column": 1},), ()),
    ],
)
def test_rows_that_fit_no_table_count_as_damaged(tmp_path, tables):
    data = encode(tables)
    folder = Path(parts_folder(tmp_path, 0))
    folder.mkdir(parents=True)
    (folder / "0.parts").write_bytes(encode_header(data, b"rows") + data)
    with pytest.raises(FrameError):
        read_part_rows(tmp_path, 0, ScenePart("0.parts", 0, len(data), 0))
