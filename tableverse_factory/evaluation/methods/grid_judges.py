"""Judges of the grid: a model server, or recorded answers."""

import json
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

from schemas.config import CurateConfig
from tableverse_factory.core.errors import AnswerInvalidError, ConfigError
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.evaluation.methods.grid import make_letters
from tableverse_factory.evaluation.methods.sources import MAX_METHODS
from tableverse_factory.evaluation.methods.vlm_vote import (
    Question,
    Vote,
    build_vote_prompt,
    build_vote_schema,
    make_vote,
    parse_vote,
    validate_vote,
)
from tableverse_factory.models.remote.client import ModelClient
from tableverse_factory.models.remote.endpoint import read_endpoint
from tableverse_factory.models.services import Services

MAX_RECORD_BYTES = 1_000_000


# Marks every method, from the question and what draws its picture as a PNG file; `ModelError` without a valid answer.
GridJudge = Callable[[Question, Callable[[], bytes]], Vote]


def ask_model(client: ModelClient, question: Question, grid: Callable[[], bytes]) -> Vote:
    """Show a model the grid and the prompt, and after an invalid answer the reason."""
    count = len(question.columns)
    reply = client.ask_for(
        lambda text: parse_vote(text, count), build_vote_prompt(count), [grid()], build_vote_schema(count)
    )
    return make_vote(question, reply.value)


def replay_vote(folder: Path, question: Question, grid: Callable[[], bytes]) -> Vote:  # noqa: ARG001
    """Read a vote of `record_vote`, `<scene>-<round>.json`; the marks belong to the columns of the recorded answer."""
    value = _read_record(folder / f"{question.name}.json")
    columns = value.get("columns")
    if not isinstance(columns, list) or sorted(map(str, columns)) != sorted(question.columns):
        raise AnswerInvalidError(f"columns {columns!r:.200} are not the methods {', '.join(question.columns)}")
    shown = Question(question.scene, question.round, tuple(map(str, columns)))
    return make_vote(shown, validate_vote(value.get("answer"), len(columns)))


def record_vote(vote: Vote, folder: Path) -> None:
    """Write a vote for `replay_vote`."""
    question = Question(vote.scene, vote.round, vote.columns)
    marks = [vote.marks[method].model_dump() for method in vote.columns]
    columns = dict(zip(make_letters(len(marks)), marks, strict=True))
    text = json.dumps({"columns": list(vote.columns), "answer": {"columns": columns}}, indent=1)
    write_atomic(folder / f"{question.name}.json", f"{text}\n".encode())


def summarize_recorded(folder: Path, most: int) -> tuple[int, frozenset[str]]:
    """Count the rounds of answers in a folder, up to `most`, and collect the methods that they name.

    Other files are ignored here; `replay_vote` refuses them when they are requested.
    """
    rounds, named = 0, set[str]()
    for path in sorted(folder.glob("*-[0-9]*.json")):
        number = path.stem.rpartition("-")[2]
        if not (number.isdecimal() and len(number) < 3 and int(number) < most):
            continue
        rounds = max(rounds, int(number) + 1)
        with suppress(AnswerInvalidError):
            columns = _read_record(path).get("columns")
            named |= set(map(str, columns)) if isinstance(columns, list) else set()
    return rounds, frozenset(named)


def _read_record(path: Path) -> dict[str, Any]:
    try:
        with path.open("rb") as file:
            data = file.read(MAX_RECORD_BYTES + 1)
    except OSError as error:
        raise AnswerInvalidError(f"no recorded answer {path.name}: {error.strerror}") from error
    try:
        value = json.loads(data[:MAX_RECORD_BYTES])
    except (ValueError, RecursionError) as error:
        raise AnswerInvalidError(f"{path.name} is not JSON: {error}"[:300]) from error
    if not isinstance(value, dict):
        raise AnswerInvalidError(f"{path.name} does not hold a JSON object")
    return value


def make_grid_judge(config: CurateConfig, services: Services) -> GridJudge:
    """Make the judge that the section `curate` names; raise a `ConfigError` for one that cannot look at pictures."""
    if config.judge == "replay":
        folder = Path(config.replay_dir)
        if not summarize_recorded(folder, MAX_METHODS)[1]:
            what = "holds no answers" if folder.is_dir() else "is not a folder"
            raise ConfigError(
                f"curate.replay_dir: {folder} {what}; give the folder answers/ that `evaluate gpt-score` wrote"
            )
        return partial(replay_vote, folder)
    if config.judge not in ("openai", "gemini"):
        raise ConfigError(
            f"curate.judge is {config.judge!r}, which cannot look at pictures: set it to openai, gemini or replay"
        )
    return partial(ask_model, ModelClient(read_endpoint(config), services))
