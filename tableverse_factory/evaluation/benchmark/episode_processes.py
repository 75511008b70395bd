"""Processes that play episodes: each loads the policy once, and one that crashes or hangs costs its episode alone."""

import json
import multiprocessing
import os
import signal
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from types import TracebackType
from typing import Any, Self

from tableverse_factory.core.errors import InputError, TableverseError
from tableverse_factory.core.process_pool import prepare_child
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.evaluation.benchmark.benchmark import Benchmark, Episode
from tableverse_factory.evaluation.benchmark.load_policy import PolicyName, load_policy
from tableverse_factory.evaluation.benchmark.play import make_result, play_episode
from tableverse_factory.evaluation.benchmark.policy import is_privileged
from tableverse_factory.evaluation.benchmark.results import EpisodeResult

LOAD_S = 600.0  # time for a process to import and load the policy [s]
MAX_MESSAGE_BYTES = 1 << 20
_EXIT_S = 5.0
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@dataclass(frozen=True, slots=True)
class PlayPlan:
    """What every process needs: the benchmark, the path of the dataset, and the policy."""

    benchmark: Benchmark
    dataset: str
    policy: PolicyName


@dataclass(frozen=True, slots=True)
class PolicyDescription:
    """What a loaded policy says of itself."""

    privileged: bool
    pictures: tuple[str, ...]
    picture_size: tuple[int, int]


class _Player:
    """The parent's side of one process."""

    def __init__(self, plan: PlayPlan) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would share locks, threads and GPU of loaded libraries
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, plan), daemon=True)
        self._process.start()
        theirs.close()
        self.description: PolicyDescription | None = None
        self.episode: Episode | None = None
        self.until, self.is_lost = time.monotonic() + LOAD_S, False

    @property
    def is_waited_for(self) -> bool:
        """Whether it loads or plays."""
        return self.description is None or self.episode is not None

    @property
    def has_ended(self) -> bool:
        """Whether its process ended between episodes."""
        return not self.is_waited_for and self._process.exitcode is not None

    def play(self, episode: Episode, limit_s: float) -> None:
        """Begin an episode, which has to end within `limit_s`."""
        self.episode, self.until, self._limit_s = episode, time.monotonic() + limit_s, limit_s
        with suppress(OSError):  # `poll` says how the process ended
            self.connection.send_bytes(episode.episode_id.encode())

    def poll(self) -> EpisodeResult | None:
        """Return the result of the episode if it has ended, also by the end of the process.

        Raises:
            InputError: if the policy or a scene does not load.
        """
        try:
            if self.connection.poll():
                return self._receive(json.loads(self.connection.recv_bytes(MAX_MESSAGE_BYTES)))
        except (EOFError, OSError):
            return self._lose("policy_crash", self._describe_end())
        except (ValueError, KeyError, TypeError):  # only a policy can have sent it that writes to our pipe
            return self._lose("policy_crash", "its process sends no result")
        if self.is_waited_for and time.monotonic() > self.until:
            return self._lose("policy_timeout", f"took longer than {self._limit_s:g} s" if self.episode else "")
        return None

    def end(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self.connection.close()

    def _receive(self, message: dict[str, Any]) -> EpisodeResult | None:
        if "error" in message:
            raise InputError(str(message["error"]), str(message["reason"]))
        if "pictures" in message:
            size = (int(message["picture_size"][0]), int(message["picture_size"][1]))
            self.description = PolicyDescription(bool(message["privileged"]), tuple(message["pictures"]), size)
            return None
        result = EpisodeResult.model_validate_json(message["result"])
        self.episode = None
        return result

    def _lose(self, reason: str, detail: str) -> EpisodeResult:
        episode, self.is_lost = self.episode, True
        if episode is None:
            why = detail or f"it takes longer than {LOAD_S:g} s"
            raise InputError(f"the policy does not load: {why}", "bad_policy")
        self.episode = None
        return make_result(episode, reason, detail)

    def _describe_end(self) -> str:
        self._process.join(_EXIT_S)
        code = self._process.exitcode
        if code is None:
            return "its process closed its pipe"
        return (
            f"its process was killed by {signal.Signals(-code).name}" if code < 0 else f"its process ended with {code}"
        )


class EpisodeProcesses:
    """Processes of one run; leave the context to end them."""

    def __init__(self, plan: PlayPlan, limit_s: float) -> None:
        """Every episode has to end within `limit_s` of wall time."""
        self._plan, self._limit_s = plan, limit_s
        self._players = [_Player(plan)]

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        for player in self._players:
            player.end()

    def describe_policy(self) -> PolicyDescription:
        """Wait until the policy is loaded, and return what it says of itself; InputError if it does not load."""
        first = self._players[0]
        while first.description is None:
            _wait(self._players)
            first.poll()
        return first.description

    def play(self, episodes: Sequence[Episode], jobs: int) -> Iterator[EpisodeResult]:
        """Yield the result of each episode as it ends, played by up to `jobs` processes.

        One that dies gives `policy_crash`, one that takes too long `policy_timeout`, and another takes its place.

        Raises:
            InputError: if the policy does not load, or a scene is not that of the benchmark.
        """
        left, players = deque(episodes), self._players
        while left or any(player.episode for player in players):
            for player in [player for player in players if player.has_ended]:
                player.end()
                players.remove(player)
            wanted = min(jobs, len(left) + sum(player.episode is not None for player in players))
            players += [_Player(self._plan) for _ in range(wanted - len(players))]
            for player in players:
                if left and not player.is_waited_for:
                    player.play(left.popleft(), self._limit_s)
            _wait(players)
            for player in tuple(players):
                if player.is_waited_for and (result := player.poll()) is not None:
                    yield result
                if player.is_lost:
                    player.end()
                    players.remove(player)


def _wait(players: Sequence[_Player]) -> None:
    """Wait until a process says something, or its time is over."""
    waited = [player for player in players if player.is_waited_for]
    left_s = min((player.until for player in waited), default=0.0) - time.monotonic()
    wait([player.connection for player in waited], max(left_s, 0.0) + 0.01)


def _serve(connection: Connection, plan: PlayPlan) -> None:
    """Play the episodes that are asked for, in the process."""
    prepare_child()
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, which ends this process
    os.environ |= dict.fromkeys(_THREADS, "1")  # of libraries that the policy imports; results depend on no machine
    os.dup2(2, 1)  # what a policy prints is no output of the command
    episodes = {episode.episode_id: episode for episode in plan.benchmark.episodes}
    try:
        dataset, policy = open_dataset(plan.dataset), load_policy(plan.policy)
        told = {"pictures": policy.pictures, "picture_size": policy.picture_size, "privileged": is_privileged(policy)}
        connection.send_bytes(json.dumps(told).encode())
        while True:
            name = connection.recv_bytes(MAX_MESSAGE_BYTES).decode()
            result = play_episode(plan.benchmark, episodes[name], dataset, policy)
            connection.send_bytes(json.dumps({"result": result.model_dump_json()}).encode())
    except EOFError:
        return
    except Exception as error:  # noqa: BLE001 the parent raises it
        told = {"error": _describe(error), "reason": getattr(error, "reason", "bad_input")}
        connection.send_bytes(json.dumps(told).encode())


def _describe(error: Exception) -> str:
    kind = "" if isinstance(error, TableverseError) else f"{type(error).__name__}: "
    return sanitize_line(kind + " ".join(str(error).split()), 500)
