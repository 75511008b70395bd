"""Pictures of scenes as a table with image columns, and shards in the hands of WebDataset."""

import io

import numpy as np
import pyarrow.parquet as pq
import pytest
import yaml
from PIL import Image

from tableverse_factory import SceneStream
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.delivery.formats.picture_table import MASKS, export_pictures
from tests.helpers.learnable_dataset import LABELS, write_learnable_dataset
from tests.helpers.recorded_dataset import two_scenes

pytestmark = pytest.mark.heavy


@pytest.fixture(scope="module")
def out(tmp_path_factory):
    return write_learnable_dataset(tmp_path_factory.mktemp("pictures") / "out", scenes=3, moved=0)


@pytest.fixture(scope="module")
def made(out, tmp_path_factory):
    dest = tmp_path_factory.mktemp("exported") / "made"
    assert export_pictures(open_dataset(out), dest) == {"train": 2, "validation": 1}
    return dest


def test_every_scene_is_a_row_of_its_split_with_its_own_bytes(out, made):
    names = sorted(path.relative_to(made).as_posix() for path in made.rglob("*") if path.is_file())
    assert names == ["README.md", "data/train-00000.parquet", "data/validation-00000.parquet"]
    (row,) = pq.read_table(made / "data/validation-00000.parquet").to_pylist()
    scene = open_dataset(out).scene(row["scene_id"])
    assert row["scene_id"] == "s-0"
    assert row["photograph"]["bytes"] == scene.files()["observation/color.jpg"]
    assert row["masks"]["bytes"] == scene.files()[MASKS]
    assert row["labels"] == list(LABELS)
    assert len(row["mask_values"]) == 3
    assert row["instructions"] == [
        "Pick up the wooden block and place it next to the bowl",
        "Pick up the wooden block and place it to the right of the bowl",
    ], "accepted tasks alone"
    head = yaml.safe_load((made / "README.md").read_text().split("---")[1])
    for files in head["configs"][0]["data_files"]:
        assert list(made.glob(files["path"]))
    assert head["license"] == ["cc-by-4.0", "cc-by-nc-4.0", "cc0-1.0"]


def test_streams_and_tables_give_the_judges_names_where_the_detector_had_none(tmp_path):
    names = ("red block", "white bowl", "tea box")
    out = write_learnable_dataset(tmp_path / "out", scenes=1, moved=0, names=names)
    export_pictures(open_dataset(out), tmp_path / "made")
    (row,) = pq.read_table(next((tmp_path / "made" / "data").iterdir())).to_pylist()
    (item,) = SceneStream(out, ("labels",))
    assert row["labels"] == item["labels"] == list(names)


def test_the_same_bytes_again_and_nothing_overwritten(out, made, tmp_path):
    export_pictures(open_dataset(out), tmp_path / "again")
    for path in made.rglob("*.parquet"):
        assert path.read_bytes() == (tmp_path / "again" / path.relative_to(made)).read_bytes()
    with pytest.raises(InputError, match="already there"):
        export_pictures(open_dataset(out), made)


def test_scenes_without_pictures_are_said(tmp_path):
    source = two_scenes(tmp_path / "out", photographed=False)
    with pytest.raises(InputError, match="no finished scene was made from a picture"):
        export_pictures(open_dataset(source), tmp_path / "made")
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_the_command_says_how_many(run, out, tmp_path):
    code, said, _ = run("export", "pictures", out, tmp_path / "made")
    assert (code, said) == (0, f"train 2, validation 1, in {tmp_path / 'made'}\n")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_datasets_shows_the_pictures(made, tmp_path):
    datasets = pytest.importorskip("datasets", reason="the package datasets is not installed")
    loaded = datasets.load_dataset(str(made), cache_dir=str(tmp_path))
    assert {split: rows.num_rows for split, rows in loaded.items()} == {"train": 2, "validation": 1}
    row = loaded["train"][0]
    assert isinstance(row["photograph"], Image.Image)
    assert row["photograph"].size == row["masks"].size == (64, 48)
    assert set(np.unique(np.asarray(row["masks"]))) == {0, 1}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_shards_are_a_webdataset(out):
    webdataset = pytest.importorskip("webdataset", reason="WebDataset is not installed")
    shards = sorted(map(str, (out / "mjcf").glob("*.tar")))
    renamed = webdataset.WebDataset(shards, rename_files=lambda name: name.replace("/", "."), shardshuffle=False)
    samples = list(renamed.decode("rgb8"))
    assert [sample["__key__"] for sample in samples] == ["s-0", "s-1", "s-2"]
    for sample in samples:
        files = open_dataset(out).scene(sample["__key__"]).files()
        assert sample["scene.xml"] == files["scene.xml"]
        assert sample["meta.json"]["scene_id"] == sample["__key__"]
        truth = np.asarray(Image.open(io.BytesIO(files["observation/color.jpg"])))
        assert sample["observation.color.jpg"].shape == truth.shape
