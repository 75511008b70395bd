"""Who comes in whose place: workers that were lost or at the end of their time are counted when another one starts."""

import itertools

from schemas.work import ChainReport
from workers.crew import Crew
from workers.executor import Answer, Ended, Lost, Started
from workers.schedule import Limits, PoolLimits, Ready


class Hall:
    """An executor whose workers exist by name only."""

    def __init__(self, recycle_after: int) -> None:
        self.limits = Limits({"physics": PoolLimits({"CPU": 1.0}, recycle_after=recycle_after)}, {"CPU": 2.0})
        self._numbers = itertools.count()

    def start(self, pool):
        return next(self._numbers)

    def submit(self, worker, jobs):
        pass

    def retire(self, worker):
        pass


def serve(crew: Crew, ranks: list[int]) -> None:
    crew.hand_out([Ready(rank, "physics", 1) for rank in ranks], lambda rank: rank)


def test_only_what_replaces_another_worker_is_a_restart():
    crew = Crew(Hall(recycle_after=2), ["physics"])
    serve(crew, [0, 1])
    assert (crew.alive["physics"], crew.restarts) == (2, 0)
    for worker in (0, 1):
        crew.hear(Started(worker))
    serve(crew, [0, 1])
    crew.hear(Lost(0, (0,), "its node is gone"))
    assert crew.restarts == 0
    serve(crew, [0])
    assert (crew.alive["physics"], crew.restarts) == (2, 1)
    crew.hear(Ended(1, tuple(Answer(rank, ChainReport(()), b"") for rank in (1, 2))))
    assert crew.alive["physics"] == 1
    serve(crew, [3, 4])
    assert (crew.alive["physics"], crew.restarts) == (2, 2)
