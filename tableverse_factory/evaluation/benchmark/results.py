"""Results of a policy on a benchmark: a header, then a row per episode, as lines of JSON."""

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, ValidationError

from schemas.curation import Relation
from schemas.identity import SafeId
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import read_bytes
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.evaluation.benchmark.benchmark import (
    MAX_EPISODES,
    Axis,
    Digest,
    Record,
    Split,
    Tier,
    describe_problem,
)

MAX_BYTES = 64 * 1024 * 1024


def _check_line(text: str) -> str:
    if sanitize_line(text, 300) != text:
        raise ValueError("text that cannot be printed on a line")
    return text


Line = Annotated[str, Field(max_length=300), AfterValidator(_check_line)]


class ResultsHeader(Record):
    """What was run: the benchmark's digest, and the policy with the digest of its file and weights.

    `weights` says which they were: the start of their own SHA-256, if they were there, and their name.
    """

    format: Literal["tableverse-results-1"] = "tableverse-results-1"
    benchmark: Digest
    policy: Annotated[Line, Field(min_length=1)]
    policy_digest: Digest
    weights: Line = ""
    privileged: bool
    pictures: Annotated[tuple[str, ...], Field(max_length=16)]
    picture_size: tuple[int, int]


class EpisodeResult(Record):
    """What came of an episode: `reason` is empty on success."""

    episode_id: SafeId
    scene_id: SafeId
    task_id: SafeId
    split: Split
    tier: Tier
    axis: Axis
    relation: Relation
    success: bool
    reason: Annotated[str, Field(pattern=r"^[a-z_]{0,60}$")]
    detail: Line
    steps: Annotated[int, Field(ge=0)]
    lifted: bool
    disturbed_m: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


def encode_results(header: ResultsHeader, rows: Iterable[EpisodeResult]) -> bytes:
    """Encode a results file; equal results give equal bytes."""
    return encode_line(header) + b"".join(map(encode_line, rows))


def encode_line(record: ResultsHeader | EpisodeResult) -> bytes:
    """Encode one line of a results file."""
    return (json.dumps(record.model_dump(mode="json"), ensure_ascii=False) + "\n").encode()


def read_results(path: str | Path) -> tuple[ResultsHeader, dict[str, EpisodeResult]]:
    """Read a results file of any origin: its header, and its rows by id of the episode.

    Raises:
        InputError: `bad_results`, naming the line and what is wrong there.
    """
    return decode_results(read_bytes(str(path), MAX_BYTES, "bad_results"), str(path))


def decode_results(data: bytes, name: str) -> tuple[ResultsHeader, dict[str, EpisodeResult]]:
    """Decode a results file (`read_results`)."""
    lines = data.split(b"\n")
    if len(lines) > MAX_EPISODES + 2 or lines[-1]:
        problem = "its last line is not whole" if lines[-1] else f"more than {MAX_EPISODES} rows"
        raise InputError(f"{name} is no results file: {problem}", "bad_results")
    number = 1
    try:
        header = ResultsHeader.model_validate_json(lines[0])
        rows: dict[str, EpisodeResult] = {}
        for number, line in enumerate(lines[1:-1], 2):
            row = EpisodeResult.model_validate_json(line)
            if row.episode_id in rows or row.success == bool(row.reason):
                raise InputError(
                    f"{name}, line {number}: an episode twice, or a success with a reason, or a failure without",
                    "bad_results",
                )
            rows[row.episode_id] = row
    except ValidationError as error:
        raise InputError(
            f"{name} is no results file: line {number}: {describe_problem(error)}", "bad_results"
        ) from None
    return header, rows
