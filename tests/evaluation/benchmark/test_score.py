"""Scores: known counts become known rates, files of others are checked, and pages escape what they say."""

import json

import pytest

from schemas.curation import Relation
from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.evaluation.benchmark.leaderboard import render_leaderboard
from tableverse_factory.evaluation.benchmark.results import (
    EpisodeResult,
    ResultsHeader,
    encode_results,
    read_results,
)
from tableverse_factory.evaluation.benchmark.score import score_results
from tableverse_factory.evaluation.methods.collisions import compute_wilson_interval


def header(policy="planner", benchmark="0" * 64, digest="1" * 64):
    return ResultsHeader(
        benchmark=benchmark, policy=policy, policy_digest=digest, privileged=False, pictures=(), picture_size=(96, 128)
    )


def row(number, success, split="test", tier="easy", axis="none", relation=Relation.ON):
    name = f"{split}_{number:04d}" + ("" if axis == "none" else f"_{axis}")
    return EpisodeResult(
        episode_id=name, scene_id=f"s-{number}", task_id="task_000", split=split, tier=tier, axis=axis,
        relation=relation, success=success, reason="" if success else "disturbed", detail="", steps=9, lifted=success,
        disturbed_m=0.0,
    )  # fmt: skip


def write(path, rows, **more):
    path.write_bytes(encode_results(header(**more), rows))
    return path


def test_rates_are_those_of_the_rows_with_wilsons_intervals(tmp_path):
    rows = [
        *(row(k, k < 3, tier="easy" if k < 2 else "hard") for k in range(4)),
        row(0, False, axis="light"),
        *(row(k, True, split="train") for k in range(2)),
    ]
    score = score_results([write(tmp_path / "a.jsonl", rows), write(tmp_path / "b.jsonl", rows[:1], policy="random")])
    rates = {(r.group, r.name): r.rates for r in score.rows}
    test, other = rates["split", "test"]
    assert (test.successes, test.episodes, test.share) == (3, 4, 0.75)
    assert (test.low, test.high) == compute_wilson_interval(0.75, 4)
    assert (other.successes, other.episodes) == (1, 1)
    assert rates["split", "train"][0].share == 1.0
    assert rates["split", "train"][1] is None, "the second policy has no such episode"
    assert [rates["tier", tier][0].successes for tier in ("easy", "hard")] == [2, 1]
    assert rates["axis", "none"][0].episodes == 1, "of the episodes that are repeated alone"
    assert rates["axis", "light"][0].share == 0.0
    assert score.reasons == ((("disturbed", 2),), ())


def test_files_of_different_benchmarks_are_not_compared(tmp_path):
    one = write(tmp_path / "a.jsonl", [row(0, True)])
    two = write(tmp_path / "b.jsonl", [row(0, True)], benchmark="2" * 64)
    with pytest.raises(InputError, match="is of benchmark 222222222222, and"):
        score_results([one, two])


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"success": False}, "a failure without"),
        ({"reason": "x"}, "a success with a reason"),
        ({"reason": "<script>"}, "line 2: reason"),
        ({"split": "secret"}, "line 2: split"),
        ({"steps": -1}, "line 2: steps"),
        ({"disturbed_m": "NaN"}, "line 2: disturbed_m"),
        ({"detail": "a\u001b[2Jb"}, "line 2: detail"),
        ({"detail": "a" * 301}, "line 2: detail"),
        ({"more": 1}, "line 2: more"),
    ],
)
def test_hostile_rows_are_refused(tmp_path, change, problem):
    path = write(tmp_path / "r.jsonl", [row(0, True)])
    first, second = path.read_text().splitlines()
    path.write_text(f"{first}\n{json.dumps(json.loads(second) | change)}\n")
    with pytest.raises(InputError, match=problem) as caught:
        read_results(path)
    assert caught.value.reason == "bad_results"


@pytest.mark.parametrize("data", [b"", b"{}\n", b"\xff\n", b"[1]\n", b'{"format": "tableverse-results-1"'])
def test_other_files_are_no_results(tmp_path, data):
    path = tmp_path / "r.jsonl"
    path.write_bytes(data)
    with pytest.raises(InputError, match="is no results file"):
        read_results(path)


def test_an_episode_counts_once(tmp_path):
    path = write(tmp_path / "r.jsonl", [row(0, True), row(0, True)])
    with pytest.raises(InputError, match="line 3: an episode twice"):
        read_results(path)


def test_the_page_escapes_names_and_tells_equal_ones_apart(tmp_path):
    name = '<img src=x onerror="alert(1)">&'
    one = write(tmp_path / "a.jsonl", [row(0, False)], policy=name, digest="a" * 64)
    two = write(tmp_path / "b.jsonl", [row(0, True)], policy=name, digest="b" * 64)
    page = render_leaderboard(score_results([one, two])).decode()
    assert "<img" not in page
    assert "<script" not in page
    assert "&lt;img src=x onerror=&#34;alert(1)&#34;&gt;&amp; aaaaaaaa" in page
    assert page.index("bbbbbbbb") < page.index("aaaaaaaa"), "the better one first"
    assert page == render_leaderboard(score_results([one, two])).decode()


def test_the_command_prints_rates_and_writes_the_page(tmp_path, capsys):
    rows = [row(k, k < 3) for k in range(4)]
    files = [str(write(tmp_path / "a.jsonl", rows)), str(write(tmp_path / "b.jsonl", rows[3:], policy="random"))]
    page = tmp_path / "leaderboard.html"
    app(["benchmark", "score", *files, "--page", str(page)], standalone_mode=False)
    printed = capsys.readouterr().out
    assert "75.0 (30–95) of 4" in printed
    assert "planner: 1 disturbed" in printed
    assert "75.0" in page.read_text()
    before = (tmp_path / "b.jsonl").read_bytes()
    with pytest.raises(ConfigError, match="it is one of the results"):
        app(["benchmark", "score", *files, "--page", str(tmp_path / "." / "b.jsonl")], standalone_mode=False)
    assert (tmp_path / "b.jsonl").read_bytes() == before
    app(["benchmark", "score", *files, "--json"], standalone_mode=False)
    told = json.loads(capsys.readouterr().out)
    assert told["rows"][0]["rates"][0]["successes"] == 3
    assert told["reasons"] == [{"disturbed": 1}, {"disturbed": 1}]
