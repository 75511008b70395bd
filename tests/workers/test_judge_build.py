"""A build whose judge is a model: without its key it stops and says so, and nothing is paid for twice."""

import json

import pytest
import trimesh
from builds import Silent, scenes
from model_server import Scripted, chat

from schemas.config import Config, CurateConfig, ObserveConfig
from tableverse_factory.errors import BuildError
from tableverse_factory.judged import judged
from tableverse_factory.manifest import make_manifest, write_manifest
from workers.build import Request, run_build

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
    return lambda out: Request(manifest, tmp_path / out, Config(curate=curation), tmp_path / "cache")


def answer() -> str:
    score = {"score": 6}
    criteria = dict.fromkeys(("category_diversity", "geometric_plausibility", "graspability", "layout_clarity"), score)
    mass = {"0": {"mass_kg": 50.0}}
    return json.dumps(
        {"usability": {"usable": True}, "per_criterion": criteria, "final_score": 6, "physical_properties": mass}
    )


def test_a_refused_key_stops_the_build_and_the_right_one_goes_on(server, request_of, monkeypatch):
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
    verdicts = judged(request_of("out").out, [0])
    assert verdicts.judges == {"openai: judge": 2}
    assert (verdicts.input_tokens, verdicts.output_tokens) == (1800, 80)
    assert verdicts.remarks["mass_clipped"] == 2
    assert verdicts.agreement.scenes == 2
    assert verdicts.agreement.mass_ratio > 10
    card = (request_of("out").out / "README.md").read_text()
    assert "The judge read 1800 tokens and wrote 80." in card
    assert "| mass\\_clipped | 2 |" in card or "| mass_clipped | 2 |" in card
    server.say(Scripted(status=500))
    monkeypatch.delenv("JUDGE_KEY")
    display = Silent()
    run_build(request_of("again"), display)
    assert "JUDGE_KEY is not set here: the judge can only repeat answers that were kept" in display.notes
    assert server.asked == []
    assert scenes(request_of("again").out) == rows
    for path in request_of("out").out.rglob("*"):
        assert path.is_dir() or KEY.encode() not in path.read_bytes()
