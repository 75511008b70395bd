"""`bench lccr` on layouts of two boxes: what it counts, and what it says of files that are none."""

import json
from pathlib import Path

import pytest

from schemas.config import Config
from tableverse_factory.bench.lccr import bench_lccr, summary
from tableverse_factory.errors import InputError
from tableverse_factory.physics.assets import obj_bytes
from tests.rectify.layouts import box


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """One layout in which two boxes overlap by 2 cm, one in which they are apart; both rest where they stand."""
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "box.obj").write_bytes(obj_bytes(box(0.1, 0.1, 0.1)))
    (tmp_path / "layouts" / "truth").mkdir(parents=True)
    for name, x in (("apart", 0.3), ("overlapping", 0.08)):
        poses = {
            "a": {"position": [0, 0, 0.05], "quaternion_wxyz": [1, 0, 0, 0]},
            "b": {"position": [x, 0, 0.05], "quaternion_wxyz": [1, 0, 0, 0]},
        }
        objects = [{"id": key, "mesh": "../meshes/box.obj", "pose": pose} for key, pose in poses.items()]
        (tmp_path / "layouts" / f"{name}.json").write_text(json.dumps({"objects": objects}))
        (tmp_path / "layouts" / "truth" / f"{name}.json").write_text(json.dumps(poses))
    return tmp_path / "layouts"


def test_the_table_of_two_layouts(folder: Path, tmp_path: Path) -> None:
    config = Config()
    scores = bench_lccr(folder, folder / "truth", 1e-4, config, tmp_path / "cache")
    direct, ours = summary(scores["Direct"]), summary(scores["LCCR"])
    assert (direct["scenes"], direct["objects"]) == (2, 4)
    assert direct["colliding on pieces [%]"] == direct["colliding on meshes [%]"] == 50.0
    assert direct["from truth, p90 [mm]"] == 0.0
    assert ours["colliding on pieces [%]"] == ours["colliding on meshes [%]"] == 0.0
    assert max(scores["LCCR"].from_observed_m) == pytest.approx(0.02 + config.rectify.clearance_m, abs=1e-6)
    assert scores["LCCR"].from_truth_m == scores["LCCR"].from_observed_m


def test_without_the_truth_its_rows_are_empty(folder: Path, tmp_path: Path) -> None:
    scores = bench_lccr(folder, None, 1e-4, Config(), tmp_path / "cache")
    assert summary(scores["LCCR"])["from truth, median [mm]"] is None


def test_bad_files_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no layout"):
        bench_lccr(tmp_path / "meshes", None, 1e-4, Config(), tmp_path / "cache")
    (folder / "truth" / "apart.json").write_text('{"a": {"position": [0, 0]}}')
    with pytest.raises(InputError, match=r"truth apart\.json"):
        bench_lccr(folder, folder / "truth", 1e-4, Config(), tmp_path / "cache")
    (folder / "apart.json").write_text("{}")
    with pytest.raises(InputError, match=r"apart\.json"):
        bench_lccr(folder, None, 1e-4, Config(), tmp_path / "cache")
