"""Prompt, answer schema and validation of the judge's vote on a grid (paper, appendix C.3)."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, StrictInt, model_validator

from tableverse_factory.core.errors import AnswerInvalidError, InputError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.methods.grid import make_letters
from tableverse_factory.models.remote.json_schema import INTEGER, STRING, Schema, object_of
from tableverse_factory.models.remote.json_text import parse_json_object, validate_answer

METRICS = ("layout_fidelity", "visual_quality", "geometry_quality", "rank")  # from 1 to 10, and 1 for the best

Points = Annotated[StrictInt, Field(ge=1, le=10)]


class Marks(BaseModel):
    """The marks of one column."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    layout_fidelity: Points
    visual_quality: Points
    geometry_quality: Points
    rank: Annotated[StrictInt, Field(ge=1)]
    reason: Annotated[str, Field(max_length=4000)] = ""


class GridAnswer(BaseModel):
    """Marks of every column by its letter; the ranks are a permutation."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    columns: dict[str, Marks]

    @model_validator(mode="after")
    def _complete(self) -> "GridAnswer":
        count = len(self.columns)
        if sorted(self.columns) != list(make_letters(count)):
            letters = ", ".join(make_letters(count))
            raise ValueError(f"columns {sorted(self.columns)!r:.100}: give each of {letters} once")
        ranks = sorted(marks.rank for marks in self.columns.values())
        if ranks != list(range(1, count + 1)):
            raise ValueError(f"ranks {ranks!r:.100}: give each of 1 to {count} once")
        return self


@dataclass(frozen=True, slots=True)
class Question:
    """One grid: a scene, and which method stands in which column."""

    scene: str
    round: int  # earlier questions about the scene; the columns rotate by one each time
    columns: tuple[str, ...]  # the methods from the left

    @property
    def name(self) -> str:
        """Name of its files."""
        return f"{self.scene}-{self.round}"


@dataclass(frozen=True, slots=True)
class Vote:
    """An answer with the marks by method; the columns are as they were shown."""

    scene: str
    round: int
    columns: tuple[str, ...]
    marks: Mapping[str, Marks]


def make_questions(scene: str, methods: tuple[str, ...], rounds: int, seed: int) -> tuple[Question, ...]:
    """The orders in which a scene's methods are shown; raise `too_many_rounds` if grids would repeat.

    The first order is drawn from the seed and the scene's name; each further round moves every method one column on, so
    that after as many rounds as there are methods each stood everywhere once, and a judge's liking for a place cancels.
    """
    if rounds > len(methods):
        raise InputError(
            f"{rounds} rounds: give at most {len(methods)}, one for each method; more would repeat the same grids",
            "too_many_rounds",
        )
    drawn = [methods[i] for i in make_rng(seed, scene, "gpt-score").permutation(len(methods))]
    turned = (drawn[-turn % len(drawn) :] + drawn[: -turn % len(drawn)] for turn in range(rounds))
    return tuple(Question(scene, number, tuple(order)) for number, order in enumerate(turned))


def build_vote_prompt(count: int) -> str:
    """Write the judge's instructions, without names of methods."""
    names = make_letters(count)
    return f"""You compare {count} reconstructions of one real table-top scene. The picture is a grid of 2 rows and \
{count + 1} columns, with a line of titles above.
- First column, upper row: a photograph of the real scene. Below it: nothing.
- Columns {", ".join(names)}: one reconstruction each. Upper row: from the front and slightly above. Lower row: from
  straight ahead, level with the table, which shows whether things float, sink in, tilt or overlap.

The reconstructions hold the objects only: a missing table, floor or background is no fault. The photograph may be taken
from elsewhere; in the reconstructions up is always up. The order of the columns is random and means nothing.

Give every column whole marks from 1 (useless) to 10 (as good as the photograph):
- layout_fidelity: are all objects there and no others, in the right places, sizes and directions to one another,
  stacked and contained as in the photograph?
- visual_quality: do surfaces and colours look natural and clear, without smears, noise or holes?
- geometry_quality: is each object of the right kind, with the right proportions and parts, not broken, melted or flat?
Then rank the columns from 1 (best) to {count} (worst) by all three together and by whether the scene could be simulated
as it stands: objects inside one another or in the air count against it. No two columns share a rank.

Answer with one JSON object and nothing else:
{json.dumps({"columns": {name: dict.fromkeys(METRICS, "integer") | {"reason": "one sentence"} for name in names}})}"""


def build_vote_schema(count: int) -> Schema:
    """Build the JSON schema of the answer, without bounds: servers refuse large grammars, `parse_vote` checks them."""
    marks = object_of({**dict.fromkeys(METRICS, INTEGER), "reason": STRING})
    return object_of({"columns": object_of(dict.fromkeys(make_letters(count), marks))})


def parse_vote(text: str, count: int) -> GridAnswer:
    """Parse the answer of a model about `count` columns; raise an `AnswerInvalidError` if it is not as asked for."""
    return validate_vote(parse_json_object(text), count)


def validate_vote(value: Any, count: int) -> GridAnswer:
    """Validate the JSON value of an answer, as `parse_vote`."""
    answer = validate_answer(value, GridAnswer)
    if len(answer.columns) != count:
        raise AnswerInvalidError(f"{len(answer.columns)} columns; there are {count}")
    return answer


def make_vote(question: Question, answer: GridAnswer) -> Vote:
    """Assign the marks of the columns to their methods."""
    named = zip(make_letters(len(question.columns)), question.columns, strict=True)
    marks = {method: answer.columns[letter] for letter, method in named}
    return Vote(question.scene, question.round, question.columns, marks)
