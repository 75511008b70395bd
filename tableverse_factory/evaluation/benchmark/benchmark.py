"""A frozen benchmark: one JSON file of self-contained episodes over the scenes of a dataset."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, Self, get_args

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, ValidationError, model_validator

from schemas.curation import Relation
from schemas.geometry import Pose
from schemas.identity import SafeId, content_hash
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import MAX_JSON_BYTES, parse_json, read_bytes
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.delivery.learning.variation import MAX_FRICTION, Variation
from tableverse_factory.physics.mjcf.spec import ASSETS

MAX_EPISODES, MAX_SCENES, MAX_ADDED = 10_000, 10_000, 16
MAX_LIMIT_STEPS = 6000

Split = Literal["train", "validation", "test", "unseen_kinds"]
Tier = Literal["easy", "medium", "hard"]
Axis = Literal["none", "start", "texture", "light", "camera", "clutter", "friction"]
SPLITS: tuple[Split, ...] = get_args(Split)
TIERS: tuple[Tier, ...] = get_args(Tier)
AXES: tuple[Axis, ...] = get_args(Axis)


def _check_unit(row: tuple[float, ...]) -> tuple[float, ...]:
    if abs(float(np.linalg.norm(row[3:])) - 1.0) > 1e-3:
        raise ValueError("its quaternion is not of unit length")
    return row


def _check_printable(text: str) -> str:
    if sanitize_line(text, 500) != text:
        raise ValueError("text that cannot be printed")
    return text


Digest = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Coordinate = Annotated[float, Field(ge=-100.0, le=100.0, allow_inf_nan=False)]
PoseRow = Annotated[tuple[Coordinate, ...], Field(min_length=7, max_length=7), AfterValidator(_check_unit)]
"""Position [m] and quaternion wxyz, in the table frame."""


class Record(BaseModel):
    """Base of what a benchmark file holds; unknown keys are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class TaskRecord(Record):
    """Task of an episode, as in tasks/."""

    task_id: SafeId
    x_id: SafeId
    y_id: SafeId
    relation: Relation
    instruction: Annotated[str, Field(max_length=500), AfterValidator(_check_printable)]


class StartRecord(Record):
    """Start: where the arm stands, and by how much objects are moved from where they were exported, at most."""

    base: PoseRow
    position_m: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    yaw_rad: Annotated[float, Field(ge=0.0, le=3.2)] = 0.0


class AddedObject(Record):
    """Object of another scene that stands on the table too, at a pose of its own frame in the table frame."""

    scene_id: SafeId
    object_id: SafeId
    pose: PoseRow


class Perturbation(Record):
    """Change of an episode along one axis; its values are drawn from the seed of the episode."""

    axis: Axis = "none"
    table: bool = False
    lights: bool = False
    cameras: bool = False
    friction: Annotated[float, Field(ge=1.0, le=MAX_FRICTION)] = 1.0
    added: Annotated[tuple[AddedObject, ...], Field(max_length=MAX_ADDED)] = ()


class DifficultyRecord(Record):
    """Difficulty (`difficulty.measure_difficulty`); lengths in metres."""

    tier: Tier
    free_m: Annotated[float, Field(ge=0.0, le=1.0)]
    clearance_m: Annotated[float, Field(ge=0.0, le=1.0)]


class Episode(Record):
    """One start of one task, and how long a policy may try."""

    episode_id: SafeId
    scene_id: SafeId
    split: Split
    seed: Seed
    limit_steps: Annotated[int, Field(ge=1, le=MAX_LIMIT_STEPS)]
    task: TaskRecord
    start: StartRecord
    difficulty: DifficultyRecord
    perturbation: Perturbation = Perturbation()

    @property
    def scenes(self) -> tuple[str, ...]:
        """Ids of the scenes whose files it needs."""
        return (self.scene_id, *(thing.scene_id for thing in self.perturbation.added))

    @property
    def base(self) -> Pose:
        """Pose of the arm's base in the table frame."""
        return Pose(np.array(self.start.base[:3]), np.array(self.start.base[3:]))

    @property
    def variation(self) -> Variation:
        """What its reset changes."""
        change = self.perturbation
        return Variation(
            self.start.position_m, self.start.yaw_rad, change.table, change.lights, change.cameras, change.friction
        )


class Benchmark(Record):
    """Episodes, with the digests of the scenes that they need (`digest_scene`)."""

    format: Literal["tableverse-benchmark-1"] = "tableverse-benchmark-1"
    seed: Seed
    robot: Annotated[str, Field(pattern=r"^[a-z0-9_]+(:[a-z0-9_]+)?$", max_length=80)]
    max_disturbed_m: Annotated[float, Field(ge=0.0, le=1.0)]
    held_out_nouns: Annotated[tuple[str, ...], Field(max_length=1000)]
    scenes: Annotated[dict[SafeId, Digest], Field(max_length=MAX_SCENES)]
    episodes: Annotated[tuple[Episode, ...], Field(min_length=1, max_length=MAX_EPISODES)]

    @model_validator(mode="after")
    def _check_ids(self) -> Self:
        if len({episode.episode_id for episode in self.episodes}) != len(self.episodes):
            raise ValueError("two episodes have the same id")
        if missing := {scene for episode in self.episodes for scene in episode.scenes} - self.scenes.keys():
            raise ValueError(f"no digest of scene {min(missing)}")
        return self

    def encode(self) -> bytes:
        """Encode the file; equal benchmarks give equal bytes."""
        return (json.dumps(self.model_dump(mode="json"), indent=1, ensure_ascii=False) + "\n").encode()

    @property
    def digest(self) -> str:
        """SHA-256 of the file, as `sha256sum` prints it."""
        return hashlib.sha256(self.encode()).hexdigest()


def read_benchmark(path: str | Path) -> Benchmark:
    """Read and check a benchmark file; InputError `bad_benchmark` for anything else."""
    data = read_bytes(str(path), MAX_JSON_BYTES, "bad_benchmark")
    value = parse_json(data, str(path), "bad_benchmark")
    try:
        return Benchmark.model_validate_json(json.dumps(value))
    except ValidationError as error:
        raise InputError(f"{path} is no benchmark: {describe_problem(error)}", "bad_benchmark") from None


def describe_problem(error: ValidationError) -> str:
    """Describe the first problem that validation found, in one line."""
    first = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in first["loc"])
    return sanitize_line(f"{where + ': ' if where else ''}{first['msg']}, not {first['input']!r:.80}", 300)


def digest_scene(files: Mapping[str, bytes]) -> str:
    """Hash what is simulated and drawn of a scene: `scene.xml` and its assets."""
    names = sorted(name for name in files if name == "scene.xml" or name.startswith(f"{ASSETS}/"))
    return content_hash(*(part for name in names for part in (name.encode(), files[name])))
