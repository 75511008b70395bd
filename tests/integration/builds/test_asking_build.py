"""Builds whose stages ask models: what they cost, what stops them, and that no question is paid for twice."""

import json
import os
import shutil
import subprocess
import sys
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from typer import Exit

from schemas.config import AskingConfig, Config, CurateConfig, PerceiveConfig, RemoteModelSection, RunConfig
from schemas.outcome import NO_COST
from tableverse_factory.cli.build import OVER_BUDGET, report_summary
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.dataset.model_costs import sum_model_costs
from tableverse_factory.run_record import read_run
from tests.helpers.builds import Silent, digests, finish, kill, scenes, wait_until, write_manifest
from tests.helpers.model_server import Scripted, chat, gemini
from tests.helpers.paths import HELPERS
from workers.driver.budget import NO_LIMITS, SpendingLimits
from workers.progress.build_state import read_build_state
from workers.run import BuildRequest, run_build
from workers.sandbox.retries import MAX_KILLS
from workers.state.checkpoint_pack import read_packed_checkpoint, scan_pack
from workers.state.cost_log import sum_costs

PRICES = {"usd_per_million_input": 100.0, "usd_per_million_output": 1000.0}
A_CHAT = 900 * 100e-6 + 40 * 1000e-6
A_GEMINI = 700 * 100e-6 + 42 * 1000e-6


def question(asked: dict) -> str:
    """The words of a question's last turn, in either protocol."""
    if "contents" in asked:
        return asked["contents"][-1]["parts"][-1]["text"]
    content = asked["messages"][-1]["content"]
    return content if isinstance(content, str) else content[-1]["text"]


@pytest.fixture
def asking(server, tmp_path, monkeypatch):
    """Makes requests of a build whose detector speaks the one protocol and whose judge the other."""
    monkeypatch.setenv("A_KEY", "sk-0123456789")
    server.on_ask = lambda asked: (gemini if "contents" in asked else chat)('{"a": 1}')

    def made(out: str, *names: str, limits: SpendingLimits = NO_LIMITS, **more) -> BuildRequest:
        manifest = write_manifest(tmp_path / "images.parquet", list(names or ("one", "two", "three")))
        where = {"base_url": server.url, "model": "m", "key_env": "A_KEY", "timeout_s": 60.0, **PRICES}
        config = Config(
            run=RunConfig(shard_size=2, deadline_s=120.0),
            perceive=PerceiveConfig(detector="openai", **where),
            curate=CurateConfig(judge="gemini", **where),
            **more,
        )
        return BuildRequest(
            manifest,
            tmp_path / out,
            config,
            tmp_path / "cache",
            pipeline="tests.helpers.model_query_pipeline:PIPELINES",
            limits=limits,
        )

    return made


def in_a_process(request: BuildRequest) -> subprocess.Popen[str]:
    """The same build in a process of its own."""
    tree = request.config.model_dump(mode="json", exclude_defaults=True)
    overrides = [f"{section}.{key}={json.dumps(value)}" for section, its in tree.items() for key, value in its.items()]
    command = [sys.executable, str(HELPERS / "run_build.py"), str(request.manifest), str(request.out), "local", "1"]
    return subprocess.Popen(
        [*command, *overrides],
        env={**os.environ, "PIPELINES_OF_TEST": request.pipeline},
        text=True,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        start_new_session=True,
    )


def test_a_build_killed_and_run_again_asks_no_model_twice_and_ends_with_the_same_bytes(server, asking, tmp_path):
    names = ("one", "slow_two", "three")
    whole = asking("whole", *names)
    run_build(whole, Silent())
    server.asked.clear()
    (tmp_path / "cache").rename(tmp_path / "other_cache")
    killed = asking("killed", *names)
    process = in_a_process(killed)
    wait_until(lambda: len(server.asked) == 4 or process.poll() is not None)
    assert process.poll() is None
    time.sleep(0.3)  # now `export` is slow, and no question is under way
    kill(process)
    run_build(killed, Silent())
    assert digests(killed.out) == digests(whole.out)
    assert Counter(map(question, server.asked)) == {
        f"{stage} {name}": 1 for stage in ("perceive", "curate") for name in names
    }
    assert sum_costs(killed.out).calls == 6


@pytest.mark.slow
def test_a_killed_build_forgets_no_money_whose_answer_it_lost(server, asking, tmp_path):
    """The scene's record and the driver's count are gone with the kill, what was written down is not."""
    request = asking("out", "slow_one")
    process = in_a_process(request)
    wait_until(lambda: len(server.asked) >= 2 or process.poll() is not None)
    time.sleep(0.3)
    kill(process)
    summary = run_build(replace(request, limits=SpendingLimits(calls=2)), Silent())
    assert summary.over_budget is None, "everything was paid for"
    assert len(server.asked) == 2
    shutil.rmtree(tmp_path / "cache")
    summary = run_build(replace(request, limits=SpendingLimits(calls=2), from_stage="perceive"), Silent())
    assert summary.over_budget.calls == 2
    assert len(server.asked) == 2


def test_calls_never_exceed_their_budget_and_a_larger_one_goes_on(server, asking):
    request = asking("out")
    for limit, left in ((1, 3), (1, 3), (5, 1)):
        summary = run_build(replace(request, limits=SpendingLimits(calls=limit)), Silent())
        assert len(server.asked) == summary.over_budget.calls == limit
        assert read_build_state(request.out).remaining == left
        assert read_build_state(request.out).failed == 0
    assert run_build(replace(request, limits=SpendingLimits(calls=6)), Silent()).over_budget is None
    assert Counter(map(question, server.asked)) == {
        f"{stage} {name}": 1 for stage in ("perceive", "curate") for name in ("one", "two", "three")
    }
    for row in scenes(request.out):
        assert (row["detector_calls"], row["detector_input_tokens"], row["detector_output_tokens"]) == (1, 900, 40)
        assert (row["judge_calls"], row["judge_input_tokens"], row["judge_output_tokens"]) == (1, 700, 42)
        assert (row["detector_usd"], row["judge_usd"]) == pytest.approx((A_CHAT, A_GEMINI))
    copy = asking("copy", limits=SpendingLimits(calls=0, usd=0.0))
    run_build(copy, Silent())
    assert len(server.asked) == 6
    assert digests(copy.out) == digests(request.out), "what answers cost is what they cost when they were first given"
    assert sum_costs(copy.out) == NO_COST


@pytest.mark.parametrize(
    ("death", "calls"), [("SIGSEGV", 3), pytest.param("SIGKILL", MAX_KILLS, marks=pytest.mark.slow)]
)
def test_a_question_that_kills_its_process_costs_no_more_with_a_budget_than_without(asking, death, calls):
    pipeline = "tests.helpers.crashing_pipeline:PIPELINES"
    for out, limits in (("out", SpendingLimits(calls=30)), ("free", NO_LIMITS)):
        request = replace(asking(out, death, limits=limits), pipeline=pipeline)
        assert run_build(request, Silent()).over_budget is None
        assert sum_costs(request.out).calls == calls
        assert read_build_state(request.out).failed == 1


def test_money_is_counted_by_the_prices_and_the_command_line_says_how_to_go_on(server, asking, run, capsys):
    two_scenes = 2 * (A_CHAT + A_GEMINI)
    stopped = asking("out", "one", "two", "three", "four", limits=SpendingLimits(usd=0.99 * two_scenes))
    summary = run_build(stopped, Silent())
    assert len(server.asked) == 4, "the last question was begun while money was left"
    assert summary.over_budget.usd == pytest.approx(two_scenes)
    with pytest.raises(Exit) as ended:
        report_summary(summary, str(stopped.out))
    assert ended.value.exit_code == OVER_BUDGET
    spent = "4 calls, 3200 tokens read, 164 written, 0.484 USD"
    assert capsys.readouterr().out.startswith(
        f"the budget is spent: {spent}, in all runs of this dataset\n"
        "still to do: 2 scenes; run the same command with a larger --max-usd or --max-calls\n"
    )
    _, figures, _ = run("status", str(stopped.out), "--json")
    assert (json.loads(figures)["spent"]["calls"], json.loads(figures)["remaining"]) == (4, 2)
    assert json.loads(figures)["costs"]["judge"]["input_tokens"] == 1400
    _, words, _ = run("status", str(stopped.out))
    assert f"spent by this dataset so far: {spent}" in words
    assert "answers of the detector's model: 2 calls, 1800 tokens read, 80 written" in words


@pytest.mark.slow  # real retries wait; tests/models/remote counts them too
def test_retries_silence_repairs_and_lost_scenes_count_too(server, asking):
    said = {
        "perceive busy": [Scripted(status=503), chat('{"a": 1}')],
        "perceive silent": [chat(""), chat('{"a": 1}')],
        "perceive prose": [chat("I see."), chat('{"a": 1}')],
        "perceive never": [chat("No."), chat("No!")],
    }
    rounds = Counter()

    def on_ask(asked):
        if "contents" in asked:
            return gemini('{"a": 1}')
        name = asked["messages"][0]["content"][-1]["text"]
        rounds[name] += 1
        return said[name][rounds[name] - 1]

    server.on_ask = on_ask
    request = asking("out", "busy", "silent", "prose", "never")
    run_build(request, Silent())
    rows = {row["name"]: row for row in scenes(request.out)}
    figures = {name: (row["detector_calls"], row["detector_input_tokens"]) for name, row in rows.items()}
    assert figures == {"busy": (2, 900), "silent": (2, 1800), "prose": (2, 1800), "never": (2, 1800)}
    assert rows["never"]["status"] == "dropped"
    assert rows["never"]["judge_calls"] is None
    assert sum_costs(request.out).calls == 8 + 3
    assert sum_model_costs(open_dataset(request.out).scenes.to_table())["detector"].input_tokens == 3 * 1800 + 900


@pytest.mark.slow
def test_a_build_goes_on_at_another_pace(server, asking):
    begun = replace(asking("out", asking=AskingConfig(per_minute=6000)), limit=1)
    run_build(begun, Silent())
    run_build(asking("out", asking=AskingConfig(max_parallel=1)), Silent())
    assert {row["status"] for row in scenes(begun.out)} == {"done"}
    assert "asking" not in read_run(begun.out / "run.json")["config"]


def test_money_without_prices_is_refused_before_anything_is_paid(run, server, tmp_path):
    manifest = write_manifest(tmp_path / "images.parquet", ["one"])
    keys = ["curate.judge=openai", f"curate.base_url={server.url}", "curate.model=m"]
    options = [word for key in keys for word in ("--set", key)]
    code, _, errors = run("build", str(manifest), str(tmp_path / "out"), "--max-usd", "5", *options)
    assert code == 1
    assert "--max-usd needs the price of m: set curate.usd_per_million_input and" in errors
    assert not (tmp_path / "out").exists()


KEY = "sk-very-secret-9876543210"


def error(status: int, **more: object) -> Scripted:
    return Scripted({"error": {"message": f"no, {KEY}", "code": status, **more}}, status)


PASSING = {
    "busy": error(429),
    "half": Scripted(b'{"choices": [{"mess' + KEY.encode()),
    "disguised": Scripted({"error": {"message": KEY, "code": 500}}),
    "broken": Scripted(write=lambda handler: handler.connection.close()),
    "odd": error(400),
    "refused": error(400, code="content_policy_violation"),
    "prose": f"I see a key: {KEY}",
    "repeated": json.dumps({"a": 1, "key": KEY}),
}
"""What costs a scene, by the name of the scene."""

STOPPING = (error(401), error(402), error(403), error(404))
"""What stops a build."""


@pytest.mark.slow
@pytest.mark.parametrize("dialect", ["openai", "gemini"])
@pytest.mark.parametrize("stage", ["perceive", "curate"])
def test_no_key_is_in_anything_that_a_build_leaves_behind(server, asking, tmp_path, monkeypatch, dialect, stage):
    monkeypatch.setenv("A_KEY", KEY)
    speak = chat if dialect == "openai" else gemini
    request = asking("out", *PASSING)
    asked = {**request.config.curate.model_dump(exclude={"judge"}), "timeout_s": 3.0}
    its = {name: value for name, value in asked.items() if name in RemoteModelSection.model_fields}
    door = {"perceive": "detector", "curate": "judge"}[stage]
    config = Config.model_validate({"run": request.config.run, stage: {door: dialect, **its}})
    said = []
    for stop in STOPPING:
        server.on_ask = lambda _, stop=stop: stop
        said.append(finish(in_a_process(replace(request, config=config))))
    assert all(code == 1 for code, _ in said)

    def on_ask(question_of):
        answer = PASSING[first_words(question_of).split()[1]]
        return speak(answer) if isinstance(answer, str) else answer

    server.on_ask = on_ask
    said.append(finish(in_a_process(replace(request, config=config))))
    assert said[-1][0] == 0
    ended = {row["name"]: row["status"] for row in scenes(request.out)}
    assert Counter(ended.values()) == {"failed": 5, "dropped": 2, "done": 1}
    assert all(KEY not in words for _, words in said)
    assert_nowhere(tmp_path)


def first_words(asked: dict) -> str:
    turn = asked["contents"][0]["parts"] if "contents" in asked else asked["messages"][0]["content"]
    return turn[-1]["text"]


def assert_nowhere(folder: Path) -> None:
    """The key is in no file, tables and records unpacked."""
    assert list(folder.rglob("*.pack"))
    for path in folder.rglob("*"):
        if path.is_file():
            assert KEY.encode() not in path.read_bytes(), path
        if path.suffix == ".parquet":
            assert KEY not in str(pq.read_table(path, partitioning=None).to_pylist()), path
        if path.suffix == ".pack":
            records = [read_packed_checkpoint(path, span.start) for _, span in scan_pack(path)]
            assert all(KEY.encode() not in record for record in records), path
