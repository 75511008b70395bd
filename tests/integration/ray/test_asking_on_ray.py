"""Budget and pace where several actors ask at once: exact in calls, no more questions at a time than allowed."""

import os
import threading
import time
from dataclasses import replace

import pytest

from schemas.config import AskingConfig, Config, CurateConfig, PerceiveConfig
from tests.helpers.builds import Silent, scenes, write_manifest
from tests.helpers.model_server import chat
from tests.helpers.paths import ROOT
from workers.driver.budget import SpendingLimits
from workers.run import BuildRequest, run_build

pytestmark = pytest.mark.slow


def test_several_actors_keep_to_one_budget_and_one_pace(server, tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    lock, under_way, most = threading.Lock(), [0], [0]

    def on_ask(asked):
        with lock:
            under_way[0] += 1
            most[0] = max(most[0], under_way[0])
        time.sleep(0.1)
        with lock:
            under_way[0] -= 1
        return chat('{"a": 1}')

    server.on_ask = on_ask
    names = [f"thing_{number}" for number in range(12)]
    where = {"base_url": server.url, "model": "m"}
    config = Config(
        perceive=PerceiveConfig(detector="openai", **where),
        curate=CurateConfig(judge="openai", **where),
        asking=AskingConfig(max_parallel=1),
    )
    request = BuildRequest(
        write_manifest(tmp_path / "m.parquet", names),
        tmp_path / "out",
        config,
        tmp_path / "cache",
        executor="ray",
        workers=2,
        limits=SpendingLimits(calls=7),
        pipeline="tests.helpers.model_query_pipeline:PIPELINES",
    )
    summary = run_build(request, Silent())
    assert len(server.asked) == summary.over_budget.calls == 7
    assert run_build(replace(request, limits=SpendingLimits(calls=24)), Silent()).over_budget is None
    assert len(server.asked) == 24
    assert most[0] == 1
    assert {row["status"] for row in scenes(request.out)} == {"done"}
