"""The consumer's side: tables of committed shards, a scene from its own bytes, clear words where there is none."""

import shutil
import subprocess
import sys
from pathlib import Path

import fsspec
import mujoco
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from schemas.manifest import ImageRow, SceneKind
from schemas.tables import OBJECTS, SCENES, TASKS
from schemas.work import SceneResult
from tableverse_factory import open_dataset
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import GALLERY_MARKER
from tableverse_factory.dataset.journals import WORK, journal_path
from tableverse_factory.dataset.parts import PartWriter
from tableverse_factory.evaluation.bench.noop_pipeline import make_minimal_scene
from tests.helpers.small_dataset import TETRAHEDRON, scene_files, write_small_dataset
from workers.state.journal import open_journal


@pytest.fixture
def out(tmp_path):
    return write_small_dataset(tmp_path / "out")


def test_tables_hold_the_committed_shards_and_no_other(out):
    dataset = open_dataset(out)
    assert dataset.shards == (0, 1)
    assert dataset.scenes.to_table().column("scene_id").to_pylist() == ["a-1", "b-2", "c-3", "c-4", "d-5"]
    assert dataset.objects.count_rows() == 9
    assert dataset.tasks.count_rows() == 3
    assert "e-6" not in dataset.objects.to_table().column("scene_id").to_pylist()
    light = dataset.objects.to_table(columns=["label"], filter=pc.field("mass_kg") < 0.5)
    assert light.to_pylist() == [{"label": "red mug"}] * 3


def test_schemas_are_those_of_the_contract_also_of_an_empty_dataset(tmp_path):
    (tmp_path / "run.json").write_text("{}")
    dataset = open_dataset(tmp_path)
    for table, schema in ((dataset.scenes, SCENES), (dataset.objects, OBJECTS), (dataset.tasks, TASKS)):
        assert table.schema.equals(schema)
        assert table.count_rows() == 0
    with pytest.raises(InputError, match="0 scenes so far"):
        dataset.scene("a-1")


@pytest.mark.parametrize("scene_id", ["a-1", "c-3", "c-4"])
def test_a_scene_is_what_was_exported(out, scene_id):
    scene = open_dataset(out).scene(scene_id)
    assert scene.files() == dict(scene_files(scene_id))
    assert scene.meta == {"scene_id": scene_id}
    assert scene.row["scene_id"] == scene_id
    model = scene.model()
    assert model.body("obj_000").id > 0
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)


def test_only_the_scenes_own_bytes_are_read(out):
    """Everything else in the shard may be garbage; and the system counts what was read."""
    shard = out / "mjcf" / "shard-00001.tar"
    row = open_dataset(out).scene("c-4").row
    start, end = row["tar_offset"], row["tar_offset"] + row["tar_size"]
    data = shard.read_bytes()
    shard.write_bytes(b"\xff" * start + data[start:end] + b"\xff" * (len(data) - end) + b"\xff" * 20_000_000)
    dataset = open_dataset(out)
    dataset.scene("c-4")  # the index of scenes is read once
    before = bytes_read()
    assert dataset.scene("c-4").files() == dict(scene_files("c-4"))
    assert bytes_read() - before < row["tar_size"] + 100_000


def bytes_read() -> int:
    return int(Path("/proc/self/io").read_text().split()[1])


def test_a_scene_that_was_lost_says_why(out):
    dataset = open_dataset(out)
    with pytest.raises(InputError, match=r"b-2 has no files: dropped at settle: not_at_rest: drift \\x1b\[2J"):
        dataset.scene("b-2")
    with pytest.raises(InputError, match="d-5 has no files: failed at place: crash: signal 11"):
        dataset.scene("d-5")


def test_an_unknown_scene_comes_with_the_nearest(out):
    dataset = open_dataset(out)
    with pytest.raises(InputError, match="nearest: a-1"):
        dataset.scene("a-11")
    for hostile in ("", "../../etc/passwd", "x" * 10_000, "a-1\x1b[2J", "\udcff", "e-6"):
        with pytest.raises(InputError) as caught:
            dataset.scene(hostile)
        assert str(caught.value).isprintable()
        assert len(str(caught.value)) < 400


def test_extract_writes_the_files_and_never_over_others(out, tmp_path):
    dest = tmp_path / "deep" / "scene"
    paths = open_dataset(out).scene("a-1").extract(dest)
    assert {str(path.relative_to(dest)): path.read_bytes() for path in paths} == dict(scene_files("a-1"))
    assert mujoco.MjModel.from_xml_path(str(dest / "scene.xml")).nbody == 3
    with pytest.raises(InputError, match="new or an empty folder"):
        open_dataset(out).scene("a-1").extract(dest)
    with pytest.raises(InputError, match="new or an empty folder"):
        open_dataset(out).scene("a-1").extract(paths[0])


def test_a_dataset_opens_by_uri(out):
    fsspec.filesystem("memory").put(str(out), "/small", recursive=True)
    for uri in (f"file://{out}", "memory://small"):
        dataset = open_dataset(uri)
        assert dataset.scenes.count_rows() == 5
        assert dataset.scene("a-1").model().nbody == 3


@pytest.mark.parametrize("path", ["nowhere", "a_file", "an_empty_folder", "a_gallery", "nosuch://x", "a::b", "\0"])
def test_what_is_no_dataset_is_said(tmp_path, monkeypatch, path):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a_gallery" / "scenes").mkdir(parents=True)
    (tmp_path / "a_gallery" / GALLERY_MARKER).write_text("{}")
    Path("a_file").write_text("x")
    Path("an_empty_folder").mkdir()
    with pytest.raises(InputError):
        open_dataset(path)


def damaged(out, name, change):
    path = out / name
    path.write_bytes(change(path.read_bytes()))
    return open_dataset(out)


def test_a_shard_cut_short_is_said(out):
    dataset = damaged(out, "mjcf/shard-00001.tar", lambda data: data[:1000])
    with pytest.raises(InputError, match="cut short"):
        dataset.scene("c-3")


def test_a_shard_of_noise_is_said(out):
    dataset = damaged(out, "mjcf/shard-00001.tar", lambda data: bytes(255 - b for b in data))
    with pytest.raises(InputError, match="no tar"):
        dataset.scene("c-3")


def test_a_missing_shard_is_said(out):
    (out / "mjcf" / "shard-00001.tar").unlink()
    with pytest.raises(InputError, match="does not read"):
        open_dataset(out).scene("c-3")
    (out / "objects" / "shard-00001.parquet").unlink()
    with pytest.raises(InputError, match="damaged"):
        open_dataset(out).table("objects")


def test_scenes_that_are_no_parquet_are_said(out):
    dataset = damaged(out, "scenes/shard-00001.parquet", lambda data: data[:-20])
    with pytest.raises(InputError, match="does not read"):
        dataset.scene("c-3")


def test_offsets_that_make_no_sense_are_said(out):
    path = out / "scenes" / "shard-00000.parquet"
    rows = pq.read_table(path).to_pylist()
    for place in ({"tar_size": 2**60}, {"tar_offset": -5}, {"tar_size": 0}, {"tar_offset": 10**9}, {"tar_size": 512}):
        pq.write_table(SCENES.empty_table().from_pylist([{**rows[0], **place}], SCENES), path)
        with pytest.raises(InputError):
            open_dataset(out).scene("a-1")


@pytest.mark.parametrize(
    "name", ["../up", "a-1/../../up", "/etc/cron.d/x", "other/scene.xml", "a-1", "a-1/a\\b", "a-1/\x1b"]
)
def test_members_that_leave_the_scene_are_refused(out, name):
    """Somebody else's dataset may be hostile."""
    forge(out, name, "0")
    with pytest.raises(InputError, match="no plain file"):
        open_dataset(out).scene("a-1")


@pytest.mark.parametrize("kind", ["1", "2", "3", "5", "6"])
def test_links_and_devices_are_refused(out, kind):
    forge(out, "a-1/link", kind)
    with pytest.raises(InputError, match="no plain file"):
        open_dataset(out).scene("a-1")


def forge(out, name, kind):
    import io
    import tarfile

    info = tarfile.TarInfo(name)
    info.type, info.linkname, info.size = kind.encode(), "/etc/passwd", len(TETRAHEDRON) if kind == "0" else 0
    tar = tarfile.open(out / "mjcf" / "shard-00000.tar", "w", format=tarfile.USTAR_FORMAT)  # noqa: SIM115
    tar.addfile(info, io.BytesIO(TETRAHEDRON))
    size = tar.offset
    tar.close()
    path = out / "scenes" / "shard-00000.parquet"
    rows = [{**row, "tar_offset": 0, "tar_size": size} for row in pq.read_table(path).to_pylist()]
    pq.write_table(SCENES.empty_table().from_pylist(rows, SCENES), path)


def test_a_model_that_mujoco_refuses_is_said(out):
    dataset = damaged(out, "mjcf/shard-00000.tar", lambda data: data.replace(b"freejoint", b"freegrape"))
    with pytest.raises(InputError, match=r"a-1: scene\.xml does not load"):
        dataset.scene("a-1").model()


@pytest.mark.heavy
def test_scenes_are_read_back_without_physics():
    code = (
        "import sys, tableverse_factory.dataset.committed_scene, tableverse_factory.dataset.scene_meta;"
        "heavy = {'mujoco', 'open3d', 'trimesh', 'scipy', 'coal', 'manifold3d'} & set(sys.modules);"
        "assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.heavy
def test_importing_the_package_is_cheap():
    code = (
        "import sys, tableverse_factory; heavy = {'pyarrow', 'numpy', 'mujoco', 'fsspec'} & set(sys.modules);"
        "assert not heavy, heavy; tableverse_factory.open_dataset; assert 'mujoco' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
    import tableverse_factory

    with pytest.raises(AttributeError, match="no attribute 'open_datset'"):
        _ = tableverse_factory.open_datset


def test_a_part_that_is_removed_before_its_shard_is_committed_is_said_in_one_line(tmp_path):
    (tmp_path / "run.json").write_text("{}")
    row = ImageRow(scene_id="s-0", kind=SceneKind.CAPTURE, uri="/x")
    part = PartWriter(tmp_path).write(0, make_minimal_scene("s-0"))
    journal = open_journal(journal_path(tmp_path, 0))
    journal.record(SceneResult(row, "done", "export", part=part))
    journal.close()
    dataset = open_dataset(tmp_path)
    assert dataset.scene("s-0").files()
    shutil.rmtree(tmp_path / WORK)
    with pytest.raises(InputError, match="s-0: its files are gone; the next run"):
        dataset.scene("s-0")
