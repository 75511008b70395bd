"""`evaluate gpt-score`: what judges see, what counts as an answer, and that marks reach the method they were meant for.

The judge is a real server that looks at the picture: methods paint their boxes in colours, and it likes red best.
"""

import base64
import io
import json
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial
from typer.testing import CliRunner

from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import AnswerInvalidError, ConfigError, InputError
from tableverse_factory.evaluation.methods.comparison import match_methods
from tableverse_factory.evaluation.methods.grid import HEADER, make_letters, read_reference, render_method
from tableverse_factory.evaluation.methods.score import (
    VoteResults,
    compute_rank_by_column,
    compute_results,
    format_interval,
)
from tableverse_factory.evaluation.methods.sources import find_scenes
from tableverse_factory.evaluation.methods.vlm_vote import Marks, Vote, build_vote_prompt, make_questions, parse_vote
from tests.helpers.model_server import Scripted, chat, gemini

CELL = 96
COLORS = {"red": (220, 30, 30), "green": (40, 190, 60), "blue": (40, 60, 220)}
METHODS = tuple(COLORS)
SCENES = ("lunch", "supper")
MARK = {"red": 9, "green": 6, "blue": 2}
RANK = {"red": 1, "green": 2, "blue": 3}


@pytest.fixture
def folder(tmp_path) -> Path:
    """Three methods of two scenes, and pictures."""
    for method, color in COLORS.items():
        (tmp_path / method).mkdir()
        for scene in SCENES:
            paint = TextureVisuals(material=PBRMaterial(baseColorFactor=[*color, 255]))
            box = trimesh.creation.box((0.1, 0.12, 0.08))
            box.visual = paint
            trimesh.Scene({"box": box}).export(tmp_path / method / f"{scene}.glb")
    (tmp_path / "pictures").mkdir()
    for scene in SCENES:
        Image.new("RGB", (320, 240), (200, 180, 20)).save(tmp_path / "pictures" / f"{scene}.png")
    return tmp_path


def methods(folder: Path) -> list[str]:
    return [part for method in METHODS for part in ("--method", f"{method}={folder / method}")]


def seen_colors(grid: Image.Image) -> list[str]:
    """Which method's colour each column shows, in the upper row and in the lower one alike."""
    pixels = np.asarray(grid.convert("RGB")).astype(float)
    found = []
    for column in range(1, grid.width // CELL):
        for row in range(2):
            cell = pixels[HEADER + row * CELL :, column * CELL :][:CELL, :CELL].reshape(-1, 3)
            vivid = cell[np.ptp(cell, axis=1) > 60].mean(axis=0)
            found.append(list(COLORS)[int(np.argmax(vivid))])
    assert found[::2] == found[1::2]
    return found[::2]


def answer(columns: list[str]) -> dict:
    marks = {c: {"layout_fidelity": MARK[c], "visual_quality": MARK[c], "geometry_quality": MARK[c]} for c in columns}
    return {"columns": {make_letters(3)[i]: {**marks[c], "rank": RANK[c], "reason": c} for i, c in enumerate(columns)}}


def look(question: dict) -> Scripted:
    """Answers by what is in the picture."""
    image = next(part for part in question["messages"][0]["content"] if part["type"] == "image_url")
    data = base64.b64decode(image["image_url"]["url"].partition(",")[2])
    return chat(json.dumps(answer(seen_colors(Image.open(io.BytesIO(data))))))


def run(*arguments: object) -> "tuple[int, str]":
    result = CliRunner().invoke(app, ["evaluate", "gpt-score", "--cell", str(CELL), *map(str, arguments)])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


def judge(server) -> list[str]:
    settings = ("judge=openai", f"base_url={server.url}", "model=eyes", "key_env=JUDGE_KEY")
    return [part for setting in settings for part in ("--set", f"curate.{setting}")]


@pytest.mark.heavy
def test_marks_reach_the_method_that_stood_in_the_column(folder, server, monkeypatch, tmp_path):
    monkeypatch.setenv("TABLEVERSE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("JUDGE_KEY", "sk-never-shown-0123456789")
    server.on_ask = look
    out = folder / "score"
    pictures = ("--reference", folder / "pictures", "--out", out)
    code, text = run(*methods(folder), *pictures, "--rounds", 3, *judge(server), "--json")
    assert code == 0, text
    found = json.loads((out / "gpt-score.json").read_text())
    assert found["ballots"] == 6
    for method in METHODS:
        assert {k: v["mean"] for k, v in found["methods"][method].items()} == {
            "layout_fidelity": MARK[method],
            "visual_quality": MARK[method],
            "geometry_quality": MARK[method],
            "rank": RANK[method],
        }
    assert set(found["rank_by_column"].values()) == {2.0}, "every method stood everywhere once"
    assert len(list((out / "grids").glob("*.png"))) == 6
    everything = text + "".join(path.read_text() for path in out.rglob("*.json"))
    assert "never-shown" not in everything

    asked = len(server.asked)
    replayed = folder / "again"
    settings = ("--set", "curate.judge=replay", "--set", f"curate.replay_dir={out / 'answers'}")
    code, text = run(*methods(folder), "--out", replayed, "--rounds", 3, "--seed", 99, *settings)
    assert code == 0, text
    again = json.loads((replayed / "gpt-score.json").read_text())
    means = {m: {k: v["mean"] for k, v in its.items()} for m, its in again["methods"].items()}
    assert means["red"]["rank"] == 1.0
    assert means["blue"]["rank"] == 3.0
    assert len(server.asked) == asked, "nobody is asked"


def test_the_grid_is_as_the_paper_has_it(folder):
    comparison = match_methods({m: folder / m for m in METHODS}, folder / "pictures", CELL)
    (question,) = make_questions("lunch", METHODS, 1, 0)
    grid = Image.open(io.BytesIO(comparison.grid(question)))
    assert grid.size == (CELL * 4, HEADER + 2 * CELL)
    pixels = np.asarray(grid)
    assert (pixels[HEADER + CELL :, 1:CELL] == 255).all(), "nothing below the real picture"
    assert tuple(pixels[HEADER + CELL // 2, CELL // 2]) == (200, 180, 20)
    assert tuple(seen_colors(grid)) == question.columns
    assert comparison.grid(question) == comparison.grid(question)


def test_the_lower_row_is_level_with_the_table(tmp_path):
    """A flat sheet is a line from straight ahead, and a surface from slightly above."""
    trimesh.Scene({"sheet": trimesh.creation.box((0.4, 0.012, 0.4))}).export(tmp_path / "sheet.glb")
    oblique, front = render_method(find_scenes(tmp_path / "sheet.glb")[0].read(), CELL)
    covered = [
        (np.ptp(view.astype(int), axis=2) + np.abs(view.astype(int) - view[0, 0]).sum(axis=2) > 30).mean()
        for view in (oblique, front)
    ]
    assert covered[0] > 5 * covered[1] > 0


def test_columns_are_shuffled_and_balanced():
    for scene in ("a", "b", "c"):
        asked = make_questions(scene, tuple("vwxyz"), 5, seed=3)
        for place in range(5):
            assert sorted(question.columns[place] for question in asked) == list("vwxyz")
        assert asked == make_questions(scene, tuple("vwxyz"), 5, seed=3)
    firsts = {make_questions(f"scene {k}", tuple("vwxyz"), 1, seed=3)[0].columns for k in range(40)}
    assert len(firsts) > 20


def test_a_judge_who_only_likes_places_ranks_nobody():
    """After as many rounds as methods, liking the first column gives all methods the same mean rank."""
    ballots = []
    for scene in ("a", "b"):
        for question in make_questions(scene, METHODS, 3, seed=0):
            marks = {m: _marks(rank=place + 1) for place, m in enumerate(question.columns)}
            ballots.append(Vote(scene, question.round, question.columns, marks))
    election = VoteResults(METHODS, tuple(ballots), ())
    assert {its["rank"].mean for its in compute_results(election, 0).values()} == {2.0}
    assert compute_rank_by_column(election) == {"A": 1.0, "B": 2.0, "C": 3.0}


def _marks(rank: int, mark: int = 5) -> Marks:
    return Marks(layout_fidelity=mark, visual_quality=mark, geometry_quality=mark, rank=rank)


def test_intervals_cover_the_mean_and_narrow_with_scenes():
    rng = np.random.default_rng(0)
    widths = []
    for count in (10, 160):
        ballots = []
        for scene in range(count):
            first = bool(rng.random() < 0.7)
            marks = {"a": _marks(1 if first else 2, 7), "b": _marks(2 if first else 1, int(rng.integers(3, 9)))}
            ballots.append(Vote(str(scene), 0, ("a", "b"), marks))
        found = compute_results(VoteResults(("a", "b"), tuple(ballots), ()), seed=1)
        assert found == compute_results(VoteResults(("a", "b"), tuple(ballots), ()), seed=1)
        its = found["a"]["rank"]
        assert its.low <= its.mean <= its.high
        assert found["a"]["layout_fidelity"].low == found["a"]["layout_fidelity"].high == 7.0
        assert found["a"]["rank"].mean + found["b"]["rank"].mean == pytest.approx(3.0)
        widths.append(its.high - its.low)
    assert widths[1] < widths[0] / 2


def test_few_scenes_have_no_interval():
    ballots = tuple(Vote(str(scene), 0, ("a",), {"a": _marks(1, 5 + scene)}) for scene in range(4))
    found = compute_results(VoteResults(("a",), ballots, ()), seed=0)["a"]["layout_fidelity"]
    assert (found.mean, found.low, found.high) == (6.5, None, None)
    assert format_interval(found) == "6.50"


@pytest.mark.heavy
def test_many_scenes_take_little_memory():
    ballots = tuple(Vote(str(scene), 0, ("a",), {"a": _marks(1, 1 + scene % 10)}) for scene in range(1500))
    tracemalloc.start()
    found = compute_results(VoteResults(("a",), ballots, ()), seed=0)["a"]["layout_fidelity"]
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert found.low < 5.5 < found.high
    assert peak < 80e6, "as it was, 2000 tables of 1500 scenes: 96 MB"


def test_no_grid_is_asked_about_twice():
    with pytest.raises(InputError, match="at most 2"):
        make_questions("a", ("x", "y"), 3, seed=0)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda its: its["A"].update(rank=2), "ranks"),
        (lambda its: its["A"].update(rank=0), "rank"),
        (lambda its: its["A"].update(layout_fidelity=11), "less than or equal to 10"),
        (lambda its: its["A"].update(visual_quality=0), "greater than or equal to 1"),
        (lambda its: its["A"].update(geometry_quality="9"), "valid integer"),
        (lambda its: its["A"].update(geometry_quality=True), "valid integer"),
        (lambda its: its["A"].update(geometry_quality=float("nan")), "valid integer"),
        (lambda its: its["A"].pop("visual_quality"), "required"),
        (lambda its: its.pop("C"), "there are 3"),
        (lambda its: its.update(D=its.pop("C")), "columns"),
        (lambda its: its.update({"<script>": its.pop("C")}), "columns"),
    ],
)
def test_answers_that_do_not_count(spoil, says):
    value = answer(["red", "green", "blue"])
    spoil(value["columns"])
    with pytest.raises(AnswerInvalidError, match=says):
        parse_vote(json.dumps(value), 3)


@pytest.mark.parametrize("text", ["", "I would say A.", "[1, 2]", '{"columns": 3}', "{" * 5000])
def test_texts_that_are_no_answers(text):
    with pytest.raises(AnswerInvalidError):
        parse_vote(text, 3)


def test_fences_and_prose_around_an_answer_do_no_harm():
    text = f"Here you are:\n```json\n{json.dumps(answer(['blue', 'red', 'green']))}\n```\nDone."
    assert parse_vote(text, 3).columns["B"].rank == 1


@pytest.mark.heavy
def test_a_bad_answer_is_asked_for_again_and_then_refused(folder, server, monkeypatch, tmp_path):
    monkeypatch.setenv("TABLEVERSE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("JUDGE_KEY", "key")
    shared = answer(["red", "green", "blue"])
    shared["columns"]["B"]["rank"] = 1
    server.say(chat(json.dumps(shared)))
    arguments = (*methods(folder), "--reference", folder / "pictures", "--out", folder / "score", *judge(server))
    code, text = run(*arguments)
    assert code == 1
    assert len(server.asked) == 4, "twice for each scene"
    assert "no valid answer: lunch, round 0" in text
    assert "ranks" in text
    assert json.loads((folder / "score" / "gpt-score.json").read_text())["methods"] == {}


@pytest.mark.heavy
def test_gemini_is_asked_in_its_own_words(folder, server, monkeypatch, tmp_path):
    monkeypatch.setenv("TABLEVERSE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("JUDGE_KEY", "key")
    server.say(gemini(json.dumps(answer(["red", "green", "blue"]))))
    settings = [part if part != "curate.judge=openai" else "curate.judge=gemini" for part in judge(server)]
    code, text = run(*methods(folder), "--reference", folder / "pictures", "--out", folder / "score", *settings)
    assert code == 0, text
    assert server.paths[0].endswith("/models/eyes:generateContent")


@pytest.mark.heavy
def test_what_cannot_be_shown_is_refused_by_name(folder, server, monkeypatch, tmp_path):
    monkeypatch.setenv("TABLEVERSE_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("JUDGE_KEY", "key")
    server.on_ask = look
    (folder / "pictures" / "lunch.png").unlink()
    (folder / "red" / "breakfast.glb").write_bytes((folder / "red" / "lunch.glb").read_bytes())
    arguments = (*methods(folder), "--reference", folder / "pictures", "--out", folder / "score", *judge(server))
    code, text = run(*arguments)
    assert code == 1
    assert "lunch, round 0: lunch: no picture of the real scene" in text
    assert "green lacks 1 scenes, e.g. breakfast" in text
    assert json.loads((folder / "score" / "gpt-score.json").read_text())["scenes"] == 1


def test_the_rules_cannot_look_at_pictures(folder):
    with pytest.raises(ConfigError, match="cannot look at pictures"):
        run(*methods(folder), "--reference", folder / "pictures", "--out", folder / "score")


@pytest.mark.parametrize("answers", ["none", "empty", "pictures"])
def test_a_folder_without_answers_is_said_before_anything_is_drawn(folder, answers):
    (folder / "empty").mkdir()
    settings = ("--set", "curate.judge=replay", "--set", f"curate.replay_dir={folder / answers}")
    with pytest.raises(ConfigError, match=f"{answers} .*answers/ that `evaluate gpt-score` wrote"):
        run(*methods(folder), "--reference", folder / "pictures", "--out", folder / "score", *settings)
    assert not (folder / "score").exists()


def test_methods_without_a_scene_in_common_are_said(folder):
    for path in (folder / "red").glob("*.glb"):
        path.rename(path.with_name(f"my_{path.name}"))
    with pytest.raises(InputError, match="matched by name, as my_lunch of red, lunch of green"):
        run(*methods(folder), "--reference", folder / "pictures", "--out", folder / "score", "--grids-only")


def test_the_prompt_names_no_method_and_every_column():
    text = build_vote_prompt(4)
    assert all(f'"{letter}"' in text for letter in "ABCD")
    assert not any(name in text for name in ("MIDI", "SAM3D", "SceneMaker", "TableVerse"))


def test_a_reference_that_is_no_picture():
    with pytest.raises(InputError, match="is not a readable picture"):
        read_reference(b"<html>", "lunch")
