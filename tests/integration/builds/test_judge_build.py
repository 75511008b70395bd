"""A build whose judge is a model: without its key it stops and says so, and nothing is paid for twice."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
import trimesh

from schemas.config import Config, CurateConfig, ObserveConfig
from schemas.outcome import ModelCost
from schemas.tables import SCENES
from tableverse_factory.cli.status import status
from tableverse_factory.core.errors import BuildError, InputError
from tableverse_factory.core.storage.parquet import build_table
from tableverse_factory.dataset.committed_rows import read_columns
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.dataset.judge_summary import JUDGEMENT_COLUMNS, summarize_judgements
from tableverse_factory.dataset.model_costs import sum_model_costs
from tableverse_factory.models.remote.json_text import MAX_ANSWER_CHARS
from tableverse_factory.sources.manifest import make_manifest, write_manifest
from tests.helpers.builds import Silent, scenes
from tests.helpers.model_server import Scripted, chat
from tests.helpers.paths import ROOT
from workers.run import BuildRequest, run_build

KEY = "sk-0123456789"


@pytest.fixture
def request_of(server, tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    for number in range(2):
        box = trimesh.creation.box((0.05, 0.05, 0.05 + 0.01 * number))
        (folder / f"box_{number}.obj").write_text(trimesh.exchange.obj.export_obj(box))
        pose = {"position": [0, 0, 0.025 + 0.005 * number], "quaternion_wxyz": [1, 0, 0, 0]}
        entry = {"id": "obj_000", "label": "box", "mesh": f"box_{number}.obj", "pose": pose}
        (folder / f"scene_{number}.json").write_text(json.dumps({"frame": "table", "objects": [entry]}))
    manifest = tmp_path / "images.parquet"
    write_manifest(manifest, make_manifest([str(folder)], ObserveConfig()).rows)
    curation = CurateConfig(judge="openai", base_url=server.url, model="judge", key_env="JUDGE_KEY")
    return lambda out: BuildRequest(manifest, tmp_path / out, Config(curate=curation), tmp_path / "cache")


def answer() -> str:
    score = {"score": 6}
    criteria = dict.fromkeys(("category_diversity", "geometric_plausibility", "graspability", "layout_clarity"), score)
    mass = {"0": {"mass_kg": 50.0}}
    return json.dumps(
        {"usability": {"usable": True}, "per_criterion": criteria, "final_score": 6, "physical_properties": mass}
    )


@pytest.mark.slow  # two builds; test_provider_failures.py refuses keys without one
def test_a_refused_key_stops_the_build_and_the_right_one_goes_on(server, request_of, monkeypatch, tmp_path):
    monkeypatch.setenv("JUDGE_KEY", KEY)
    server.say(Scripted({"error": {"message": KEY}}, 401))
    with pytest.raises(BuildError, match="refuses the key in JUDGE_KEY") as caught:
        run_build(request_of("out"), Silent())
    assert KEY not in str(caught.value)
    assert len(server.asked) == 1
    server.say(chat(answer()))
    run_build(request_of("out"), Silent())
    rows = scenes(request_of("out").out)
    assert [row["status"] for row in rows] == ["done", "done"]
    assert [row["judge_input_tokens"] for row in rows] == [900, 900]
    assert all("mass_clipped:obj_000" in row["judge_remarks"] for row in rows)
    assert len(server.asked) == 2
    verdicts = summarize_judgements(read_columns(request_of("out").out, "scenes", [0], JUDGEMENT_COLUMNS))
    assert verdicts.judges == {"openai: judge": 2}
    assert sum_model_costs(open_dataset(request_of("out").out).scenes.to_table()) == {"judge": ModelCost(2, 1800, 80)}
    assert verdicts.remarks["mass_clipped"] == 2
    assert verdicts.agreement.scenes == 2
    assert verdicts.agreement.mass_ratio > 10
    card = (request_of("out").out / "README.md").read_text()
    assert "| judge | 2 | 1800 | 80 | – |" in card
    assert "| mass_clipped | 2 |" in card
    server.say(Scripted(status=500))
    monkeypatch.delenv("JUDGE_KEY")
    display = Silent()
    run_build(request_of("again"), display)
    assert "JUDGE_KEY is not set here: the judge can only repeat cached answers" in display.notes
    assert server.asked == []
    assert scenes(request_of("again").out) == rows
    assert_key_nowhere(tmp_path)


def test_a_key_that_a_server_repeats_comes_into_no_table(server, request_of, monkeypatch, tmp_path):
    monkeypatch.setenv("JUDGE_KEY", KEY)
    server.say(Scripted({"error": {"message": f"no such field beside {KEY}"}}, 400))
    run_build(request_of("out"), Silent())
    rows = scenes(request_of("out").out)
    assert [row["status"] for row in rows] == ["failed", "failed"]
    assert all("no such field beside ***" in row["detail"] for row in rows)
    assert_key_nowhere(tmp_path)


def assert_key_nowhere(folder: Path) -> None:
    """Tables are compressed, so they are read; everything else is looked at as it lies there."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    tables = [path for path in files if path.suffix == ".parquet"]
    assert tables
    for path in tables:
        assert KEY not in str(pq.read_table(path, partitioning=None).to_pylist()), path
    for path in files:
        assert KEY.encode() not in path.read_bytes(), path


@pytest.mark.slow  # three builds of real scenes; tests/stages/curate replays answers
def test_the_recipe_of_the_docs_repeats_a_build_also_with_the_longest_answer(server, request_of, monkeypatch, tmp_path):
    monkeypatch.setenv("JUDGE_KEY", KEY)
    prose = "… “thinking”\r\n"
    text = answer()
    server.say(chat((prose * MAX_ANSWER_CHARS)[: MAX_ANSWER_CHARS - len(text)] + text))
    run_build(request_of("out"), Silent())
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "models.md").read_text()
    exec(re.search(r"```python\n(.*?answers\.mkdir.*?)```", page, re.DOTALL)[1], {})  # noqa: S102
    paid = request_of("out")
    again = replace(
        paid, out=tmp_path / "again", config=Config(curate=CurateConfig(judge="replay", replay_dir="answers"))
    )
    run_build(again, Silent())
    kept = ("scene_id", "status", "quality_score", "answered_score", "usable", "judge_remarks", "rules_mass_ratio")
    first, second = ([{name: row[name] for name in kept} for row in scenes(it.out)] for it in (paid, again))
    assert first == second
    assert [row["status"] for row in first] == ["done", "done"]


@pytest.mark.slow  # a build for a table that no build writes
def test_a_figure_that_is_none_is_told_and_never_printed_as_json(server, request_of, monkeypatch, capsys):
    monkeypatch.setenv("JUDGE_KEY", KEY)
    server.say(chat(answer()))
    out = request_of("out").out
    run_build(request_of("out"), Silent())
    status(str(out), as_json=True)
    assert json.loads(capsys.readouterr().out)["judged"]["agreement"]["mass_ratio"] > 10
    (path,) = (out / "scenes").glob("*.parquet")
    rows = [{**row, "rules_mass_ratio": math.inf} for row in pq.read_table(path).to_pylist()]
    pq.write_table(build_table(rows, SCENES), path)
    with pytest.raises(InputError, match="no number"):
        status(str(out), as_json=True)
    assert capsys.readouterr().out == ""
