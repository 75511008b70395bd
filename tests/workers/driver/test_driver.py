"""The driver's decisions, on an executor in memory: no process, no Ray."""

from typing import Any

import pytest

from schemas.config import Config, CurateConfig
from schemas.outcome import Dropped, Failed, ModelCost
from tableverse_factory.core.errors import BuildError
from tests.helpers.fake_executor import (
    LOSE_INPUT,
    LOSE_WORKER,
    RAISE_IN_WORKER,
    STAGES,
    FakeBuild,
    FakeExecutor,
    make_rows,
)
from workers.driver.budget import SpendingLimits
from workers.driver.driver import MAX_LOSSES_PER_CALL, MAX_LOSSES_PER_SCENE
from workers.driver.signals import StoppedError
from workers.executors.protocol import Event, Job, WorkerLost


def stop_after(n: int):
    """A check that stops the driver at its n-th call."""
    calls = iter(range(n))

    def check() -> None:
        if next(calls, None) is None:
            raise StoppedError(2)

    return check


def test_every_scene_ends_done(tmp_path):
    build = FakeBuild(tmp_path, make_rows(20), workers=3)
    results = build.run()
    assert {result.status for result in results.values()} == {"done"}
    assert [timing.stage for timing in results["s0"].timings] == [stage.name for stage in STAGES]
    assert build.tally.ended["pack", "done"] == 20
    assert build.tally.passed == {"look": 20, "settle": 20, "judge": 20}
    assert set(build.executor.runs.values()) == {1}


def test_drops_and_failures_end_where_they_happen(tmp_path):
    script = {
        ("s0", 1): [Dropped("not_at_rest", "drift 0.5 m")],
        ("s1", 0): [Failed("crash", "SIGSEGV")],
        ("s2", 3): [Failed("exception", "KeyError")],
    }
    results = FakeBuild(tmp_path, make_rows(4), script).run()
    assert [(r.status, r.stage) for _, r in sorted(results.items())] == [
        ("dropped", "settle"),
        ("failed", "look"),
        ("failed", "pack"),
        ("done", "pack"),
    ]
    assert (results["s0"].reason, results["s0"].detail) == ("not_at_rest", "drift 0.5 m")
    assert (results["s1"].error_kind, results["s1"].attempts) == ("crash", 2)


def test_rejected_rows_are_dropped_without_a_worker(tmp_path):
    build = FakeBuild(tmp_path, make_rows(3, rejected="unreadable_color"))
    assert {(r.status, r.stage, r.reason) for r in build.run().values()} == {
        ("dropped", "manifest", "unreadable_color")
    }
    assert not build.executor.runs


def test_lost_workers_do_not_count_as_attempts(tmp_path):
    build = FakeBuild(tmp_path, make_rows(1), {("s0", 2): [LOSE_WORKER] * (MAX_LOSSES_PER_SCENE - 1)})
    result = build.run()["s0"]
    assert (result.status, result.attempts) == ("done", 1)
    assert build.tally.losses == MAX_LOSSES_PER_SCENE - 1
    assert build.executor.runs["s0", 0] == 1, "finished stages are resumed from their checkpoints"
    assert [timing.stage for timing in result.timings].count("judge") == 1


def test_a_scene_that_loses_every_worker_fails(tmp_path):
    script = {("s0", 1): [LOSE_WORKER] * MAX_LOSSES_PER_SCENE}
    results = FakeBuild(tmp_path, make_rows(3), script).run()
    assert (results["s0"].status, results["s0"].error_kind) == ("failed", "lost")
    assert {results["s1"].status, results["s2"].status} == {"done"}


def test_losses_without_any_result_stop_the_build(tmp_path):
    script = {(f"s{i}", 0): [LOSE_WORKER] * 99 for i in range(MAX_LOSSES_PER_CALL)}
    with pytest.raises(BuildError, match=r"10 workers were lost in a row, the last one with: its node is gone"):
        FakeBuild(tmp_path, make_rows(MAX_LOSSES_PER_CALL), script).run()


def test_a_worker_that_raises_costs_its_scene_nothing(tmp_path):
    errors = MAX_LOSSES_PER_SCENE + 1
    build = FakeBuild(tmp_path, make_rows(1), {("s0", 2): [RAISE_IN_WORKER] * errors}, workers=errors)
    result = build.run()["s0"]
    assert (result.status, result.attempts) == ("done", 1)
    assert build.executor.runs["s0", 2] == errors + 1


@pytest.mark.parametrize("place", [("s0", 0), ("commit", 0)])
def test_workers_that_only_raise_stop_the_build_with_what_they_raised(tmp_path, place):
    build = FakeBuild(tmp_path, make_rows(2), {place: [RAISE_IN_WORKER] * 99})
    with pytest.raises(BuildError, match=r"3 workers raised errors in a row, the last one with: node n: OSError: no r"):
        build.run()
    assert not any(result.status == "failed" for result in build.ledger.results.values())


class OneSlowMachineAndOneFull(FakeExecutor):
    """A worker whose calls take long, and others that raise at once, in whose place new ones start."""

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._late: list[tuple[Job, ...]] = []
        self._waits = 0

    def submit(self, worker: int, jobs: tuple[Job, ...]) -> None:
        if worker > 1:
            self._events.append(WorkerLost(worker, jobs, "node b: OSError: no room", raised=True))
        else:
            self._late.append(jobs)

    def wait(self, timeout_s: float) -> list[Event]:
        self._waits += 1
        if self._late and self._waits % 50 == 0:
            super().submit(1, self._late.pop())
        return super().wait(timeout_s)


def test_where_one_machine_raises_at_once_the_others_are_awaited(tmp_path):
    build = FakeBuild(tmp_path, make_rows(3), workers=2, executor=OneSlowMachineAndOneFull)
    assert {result.status for result in build.run().values()} == {"done"}


def test_a_lost_input_is_computed_again(tmp_path):
    build = FakeBuild(tmp_path, make_rows(1), {("s0", 0): [LOSE_INPUT]})
    assert build.run()["s0"].status == "done"
    assert build.executor.runs["s0", 0] == 2


def test_an_interrupted_build_resumes_from_checkpoints(tmp_path):
    first = FakeBuild(tmp_path, make_rows(2), {("s0", 2): [LOSE_WORKER] * 9})
    with pytest.raises(StoppedError):
        first.run(stop_after(3))
    assert first.executor.runs["s0", 0] == 1
    assert "s0" not in first.ledger.results
    second = FakeBuild(tmp_path, make_rows(2))
    assert {result.status for result in second.run().values()} == {"done"}
    assert ("s0", 0) not in second.executor.runs
    assert second.executor.runs["s0", 2] == 1


@pytest.mark.parametrize("stop", [StoppedError(2), KeyboardInterrupt()])
def test_a_stop_keeps_what_is_recorded(tmp_path, stop):
    build = FakeBuild(tmp_path, make_rows(30))
    looks = []

    def check() -> None:
        looks.append(0)
        if build.ledger.results:
            raise stop

    with pytest.raises(type(stop)):
        build.run(check)
    assert 0 < len(build.ledger.results) < 30


def test_a_spent_budget_ends_the_run_and_the_rest_waits(tmp_path):
    script = {
        ("s0", 2): [ModelCost(calls=1, usd=0.5)],
        **{(f"s{i}", 2): [Failed("BudgetSpentError", "the budget is spent")] for i in range(1, 4)},
    }
    config = Config(curate=CurateConfig(judge="openai", model="m", base_url="http://127.0.0.1:1/v1"))
    build = FakeBuild(tmp_path, make_rows(4), script, SpendingLimits(calls=1), config)
    results = build.run()
    assert build.driver.out_of_budget
    assert list(results) == ["s0"]
    assert dict(results["s0"].costs) == {"judge": ModelCost(calls=1, usd=0.5)}
    assert build.budget.spent == ModelCost(calls=1, usd=0.5)


def test_a_shard_is_committed_although_the_budget_is_spent_and_no_worker_is_left(tmp_path):
    script = {
        ("s0", 2): [ModelCost(calls=100)],
        ("s1", 2): [Failed("BudgetSpentError", "the budget is spent")],
        ("commit", 0): [LOSE_WORKER] * 2,
    }
    config = Config(curate=CurateConfig(judge="openai", model="m", base_url="http://127.0.0.1:1/v1"))
    build = FakeBuild(tmp_path, make_rows(2), script, SpendingLimits(calls=100), config, workers=2)
    build.ledger.n_scenes = 1
    assert list(build.run()) == ["s0"]
    assert build.driver.out_of_budget
    assert build.ledger.published == 1


def test_a_finished_scene_that_does_not_read_is_made_from_its_checkpoints(tmp_path):
    build = FakeBuild(tmp_path, make_rows(2))
    build.ledger.unreadable = [[0]]
    results = build.run()
    assert (len(results), build.ledger.published) == (2, 1)
    assert [build.executor.runs["s0", position] for position in range(4)] == [1, 1, 1, 2]
    assert build.display.notes == ["1 finished scene does not read"]


def test_notes_show_few_tracebacks(tmp_path):
    script = {(f"s{i}", 0): [Failed("exception", "KeyError")] for i in range(6)}
    build = FakeBuild(tmp_path, make_rows(6), script)
    build.run()
    assert len(build.display.notes) == 6
    assert sum("\ntrace" in note for note in build.display.notes) == 3
