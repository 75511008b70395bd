"""`evaluate tables`: methods in subfolders become the paper's two tables, the judge's columns from recorded answers."""

import io
import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from schemas.config import Config
from schemas.geometry import Pose
from schemas.outcome import Done
from schemas.scene import ExportedScene, SettledScene
from schemas.tables import TABLES
from tableverse_factory.cli.main import app
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.shards import TarShard
from tableverse_factory.evaluation.methods.ablation import CONFIGURATIONS, find_ablation_scenes, list_configurations
from tableverse_factory.evaluation.methods.collisions import measure_method
from tableverse_factory.evaluation.methods.comparison import match_methods
from tableverse_factory.evaluation.methods.grid import HEADER
from tableverse_factory.evaluation.methods.grid_judges import record_vote
from tableverse_factory.evaluation.methods.sources import find_scenes
from tableverse_factory.evaluation.methods.vlm_vote import Marks, Vote, make_questions
from tableverse_factory.models.services import Services
from tableverse_factory.stages.export.export import export
from tests.helpers.known_penetrations import write_glbs
from tests.helpers.simple_scenes import Solid, as_settled, box, curated, layout

pytestmark = pytest.mark.heavy

SIDE, PLACED_DEPTH = 0.06, 0.004


def exported(scene_id: str) -> ExportedScene:
    """Two boxes that the picture put 4 mm inside one another, moved apart since then."""
    solids = [
        Solid(box(SIDE, SIDE, SIDE), (0.0, 0.0, SIDE / 2)),
        Solid(box(SIDE, SIDE, SIDE), (SIDE - PLACED_DEPTH, 0.0, SIDE / 2)),
    ]
    placed = layout(solids, scene_id=scene_id)
    apart = (placed.poses[0], Pose(np.array([SIDE + 0.002, 0.0, SIDE / 2]), placed.poses[1].quaternion_wxyz))
    rectified = type(placed)(scene_id, placed.placed, placed.pieces, apart, placed.groups, PLACED_DEPTH)
    settled = as_settled(rectified)
    assert isinstance(settled, SettledScene)
    outcome = export(curated(settled), Config(), np.random.default_rng(0), Services(Path("unused")))
    assert isinstance(outcome, Done), outcome
    return outcome.value


def write_dataset(out: Path, scenes: list[ExportedScene]) -> Path:
    for folder in ("mjcf", *TABLES):
        (out / folder).mkdir(parents=True)
    (out / "run.json").write_text("{}")
    rows: dict[str, list] = {"scenes": [], "objects": [], "tasks": []}
    with (out / "mjcf/shard-00000.tar").open("wb") as file:
        tar = TarShard(file)
        for scene in scenes:
            offset, size = tar.add(scene)
            place = {"status": "done", "shard": 0, "tar_offset": offset, "tar_size": size}
            rows["scenes"].append({**scene.scene_row, "scene_id": scene.scene_id, **place})
        rows["scenes"].append({"scene_id": "lost", "status": "dropped", "stage": "settle", "shard": 0})
        tar.close()
    for name, schema in TABLES.items():
        (out / name / "shard-00000.parquet").write_bytes(encode_parquet(build_table(rows.get(name, []), schema)))
    return out


@pytest.fixture(scope="module")
def results(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    write_dataset(folder / "ours", [exported(f"{name}-0123456789ab") for name in ("clean", "two")])
    write_glbs(folder / "their|s")
    for scene, rank in (("clean", 1), ("two", 2)):
        marks = {"ours": _marks(8, rank), "their|s": _marks(4, 3 - rank)}
        record_vote(Vote(scene, 0, ("their|s", "ours"), marks), folder / "answers")
    return folder


def _marks(mark: int, rank: int) -> Marks:
    return Marks(layout_fidelity=mark, visual_quality=mark, geometry_quality=mark, rank=rank)


def test_the_ablation_is_read_from_the_poses_of_every_step(results):
    depths = {
        row: measure_method(row, find_ablation_scenes(results / "ours", poses), 1e-3, None).scenes[0].depth_m
        for row, poses in CONFIGURATIONS.items()
    }
    assert depths["Direct"] == pytest.approx(PLACED_DEPTH, abs=1e-6)
    assert depths["Direct + LCCR"] == depths["Direct + LCCR + Simulation"] == 0.0


def test_what_was_rectified_by_another_method_is_not_called_lccr(results, tmp_path):
    (tmp_path / "run.json").write_text('{"config": {"rectify": {"method": "joint"}}}')
    assert list(list_configurations(tmp_path)) == ["Direct", "Direct + joint", "Direct + joint + Simulation"]
    assert list(list_configurations(results / "ours")) == list(CONFIGURATIONS)


@pytest.mark.parametrize("spoil", [{"scale": "x", "poses": 3}, {"scale": 0}, {"scale": None, "poses": {"placed": [1]}}])
def test_a_meta_that_makes_no_sense_is_a_row_with_its_reason(spoil, tmp_path):
    scene = exported("clean-0123456789ab")
    files = dict(scene.files)
    meta = json.loads(files["meta.json"])
    meta["objects"] = [{**entry, "poses": {}, **spoil} for entry in meta["objects"]]
    files["meta.json"] = json.dumps(meta).encode()
    out = write_dataset(tmp_path / "ours", [replace(scene, files=tuple(sorted(files.items())))])
    for sources in (find_scenes(out), find_ablation_scenes(out, "placed")):
        (measured,) = measure_method("x", sources, 1e-3, None).scenes
        assert "meta.json" in measured.error or "is not a pose" in measured.error


def test_both_tables_are_written(results, tmp_path):
    arguments = ["evaluate", "tables", str(results), "--out", str(tmp_path / "tables"), "--epsilon", "0.001"]
    answer = CliRunner().invoke(app, arguments)
    assert answer.exit_code == 0, answer.output
    found = json.loads((tmp_path / "tables" / "tables.json").read_text())
    assert found["epsilon_m"] == 0.001
    ours, theirs = found["table1"]
    assert (ours["method"], ours["measured"], ours["collision_rate"]) == ("ours", 2, 0.0)
    assert (theirs["method"], theirs["measured"], theirs["collision_rate"]) == ("their|s", 2, 0.5), "shared scenes only"
    assert (theirs["own_measured"], theirs["own_collision_rate"]) == (5, 0.6)
    assert (ours["dropped"], theirs["dropped"]) == (1, None)
    assert ours["layout_fidelity"]["mean"] == 8.0
    assert ours["rank"]["mean"] == theirs["rank"]["mean"] == 1.5
    assert found["ballots"] == 2
    assert [row["collision_rate"] for row in found["table2"]] == [1.0, 0.0, 0.0]
    first = (tmp_path / "tables" / "table1.md").read_text().splitlines()
    assert first[0] == "| Method | Scenes | Dropped | Scene Collision Rate (%) ↓ | LF ↑ | VQ ↑ | GQ ↑ | Avg. Rank ↓ |"
    assert first[2].startswith("| ours | 2 (2) | 1 | 0.0 (")
    assert first[3].startswith("| their\\|s | 2 (5) | – | 50.0 (")
    assert all(line.replace("\\|", "").count("|") == 9 for line in first[:4])
    second = (tmp_path / "tables" / "table2.md").read_text()
    assert "| ours | Direct | 2 | 100.0 (" in second


def run_tables(folder: Path, out: Path) -> tuple[int, str]:
    answer = CliRunner().invoke(app, ["evaluate", "tables", str(folder), "--out", str(out), "--epsilon", "0.001"])
    assert answer.exception is None or isinstance(answer.exception, SystemExit), answer.exception
    return answer.exit_code, (out / "table1.md").read_text()


def test_answers_hold_for_the_methods_that_they_name(results, tmp_path):
    """A method that came later has no marks; those of the others stay."""
    shutil.copytree(results, tmp_path / "results")
    write_glbs(tmp_path / "results" / "later")
    code, text = run_tables(tmp_path / "results", tmp_path / "tables")
    assert code == 0
    marks = {line.split(" | ")[0].strip("| "): line.count("–") for line in text.splitlines()[2:5]}
    assert marks["later"] >= 4 > marks["ours"]


def test_answers_that_do_not_count_are_said(results, tmp_path):
    shutil.copytree(results, tmp_path / "results")
    answers = tmp_path / "results" / "answers"
    (answers / "clean-300000.json").write_text("{}")
    assert run_tables(tmp_path / "results", tmp_path / "stray")[0] == 0, "no round has that number"
    (answers / "clean-0.json").write_text("no answer")
    code, text = run_tables(tmp_path / "results", tmp_path / "broken")
    assert code == 1
    assert "1 answers of the judge do not count, the first: clean, round 0: clean-0.json is not JSON" in text
    shutil.rmtree(tmp_path / "results" / "their|s")
    code, text = run_tables(tmp_path / "results", tmp_path / "gone")
    assert code == 1
    assert "the answers name their\\|s: there is no such method" in text


def test_what_the_factory_dropped_is_said(results):
    answer = CliRunner().invoke(app, ["evaluate", "collisions", str(results / "ours"), "--meshes-only"])
    assert answer.exit_code == 0
    assert "ours: without 1 scenes that the factory dropped" in answer.stdout


def test_without_answers_the_judge_s_columns_are_empty(results, tmp_path):
    (tmp_path / "none").mkdir()
    arguments = ["evaluate", "tables", str(results), "--out", str(tmp_path), "--answers", str(tmp_path / "none")]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert "| – | – | – | – |" in (tmp_path / "table1.md").read_text()


def test_a_folder_without_methods_is_an_error(tmp_path, monkeypatch, capsys):
    from tableverse_factory.cli.main import main

    (tmp_path / "answers").mkdir()
    monkeypatch.setattr(sys, "argv", ["tableverse", "evaluate", "tables", str(tmp_path), "--out", str(tmp_path / "t")])
    with pytest.raises(SystemExit) as exit_:
        main()
    assert exit_.value.code == 1
    assert "no methods" in capsys.readouterr().err


def test_a_dataset_brings_the_real_pictures_along(tmp_path):
    """Without a folder of references, the picture that a scene was made from is the one in its shard."""
    scene, picture = exported("lunch-0123456789ab"), io.BytesIO()
    Image.new("RGB", (64, 48), (10, 200, 30)).save(picture, "JPEG")
    files = tuple(sorted({**dict(scene.files), "observation/color.jpg": picture.getvalue()}.items()))
    write_dataset(tmp_path / "ours", [replace(scene, files=files)])
    comparison = match_methods({"ours": tmp_path / "ours", "again": tmp_path / "ours"}, side=64)
    assert comparison.scenes == ("lunch",)
    (question,) = make_questions("lunch", comparison.methods, 1, 0)
    grid = np.asarray(Image.open(io.BytesIO(comparison.grid(question))))
    assert grid[HEADER + 32, 32] == pytest.approx([10, 200, 30], abs=4)
