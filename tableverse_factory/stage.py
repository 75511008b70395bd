"""Declaration of a stage: a pure function and its needs, which executors, checkpoints and commits obey."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Literal, cast

import numpy as np

from schemas.config import Config
from schemas.manifest import SceneKind
from schemas.outcome import Dropped, Failed, Outcome
from tableverse_factory.models.services import Services

Pool = Literal["perception", "geometry", "physics", "curation", "trajectories"]

StageFunction = Callable[[Any, Config, np.random.Generator, Services], Outcome[Any]]

# `record(config, before) -> JSON value`, or None if the stage does not read that input; `before` is run.json.
RecordFunction = Callable[[Config, Mapping[str, Any]], Any]

# `check(config, kinds, here)` raises if what a stage loads for rows of these kinds is missing or damaged; `here` says
# whether the stages run on this machine.
CheckFunction = Callable[[Config, Collection[SceneKind], bool], None]


@dataclass(frozen=True, slots=True)
class DeferredFunction:
    """Function of a stage that is imported when it is first needed.

    Stages bring native libraries, seconds of import, and a process that only plans a build or reads one runs none.

    Attributes:
        address: `module:name`.
    """

    address: str

    @property
    def module(self) -> str:
        """Name of its module."""
        return self.address.partition(":")[0]

    def load(self) -> StageFunction:
        """Import the function."""
        return cast(StageFunction, getattr(import_module(self.module), self.address.partition(":")[2]))

    def __call__(self, item: Any, config: Config, rng: np.random.Generator, services: Services) -> Outcome[Any]:
        """Run the function."""
        return self.load()(item, config, rng, services)


@dataclass(frozen=True, slots=True)
class Stage:
    """One step of a pipeline.

    Attributes:
        name: Also the name of its random stream.
        run: `run(item, config, rng, services) -> Outcome`. Pure: no clock, no global state, no other randomness. A
            `DeferredFunction` is imported by the first process that runs it; sandboxes do so before their first scene.
        reads: The sections or `section.key`s that it reads, its own first. Other changes leave its output valid.
        recorded: What it reads besides (prompts, weights, robot files), by part of run.json: a change of these makes
            another build.
        check: Of a stage that loads models: before anything of a build is written or started, whether it can.
        record_failure: Of a stage that adds to exported scenes: `record_failure(item, config, failure)` returns its
            input with rows that say why the stage failed. The scene stays done then. None for every stage up to the
            export.
    """

    name: str
    pool: Pool
    run: StageFunction
    reads: tuple[str, ...]
    recorded: Mapping[str, RecordFunction] = field(default_factory=dict)
    check: CheckFunction | None = None
    record_failure: Callable[[Any, Config, Dropped | Failed], Any] | None = None

    @property
    def section(self) -> str:
        """Its own section of the configuration, which also holds its deadline."""
        return self.reads[0].partition(".")[0]

    @property
    def is_post_export(self) -> bool:
        """Whether it takes an exported scene and returns it with more in it."""
        return self.record_failure is not None

    def select_values(self, config: Config) -> dict[str, Any]:
        """Select what it reads of a configuration, by dotted key, without the deadline, which changes no output."""
        tree = config.model_dump(mode="json")
        found: dict[str, Any] = {}
        for name in self.reads:
            section, _, key = name.partition(".")
            keys = [key] if key else [key for key in tree[section] if key != "deadline_s"]
            found |= {f"{section}.{key}": tree[section][key] for key in keys}
        return found


Pipelines = Mapping[SceneKind, Sequence[Stage]]  # the stages that a manifest row of each kind runs through, in order


def import_stages(pipelines: Iterable[Sequence[Stage]]) -> None:
    """Import what the stages run, so that it counts in no stage's time."""
    for _, run in _list_deferred(pipelines):
        run.load()


def check_stages(pipelines: Iterable[Sequence[Stage]]) -> None:
    """Raise ModuleNotFoundError if the module of a stage is not there, without importing it."""
    for name, run in _list_deferred(pipelines):
        if find_spec(run.module) is None:
            raise ModuleNotFoundError(f"no module named {run.module!r}, of stage {name}")


def _list_deferred(pipelines: Iterable[Sequence[Stage]]) -> list[tuple[str, DeferredFunction]]:
    stages = (stage for line in pipelines for stage in line)
    return [(stage.name, stage.run) for stage in stages if isinstance(stage.run, DeferredFunction)]


def post_export_stages(pipelines: Pipelines) -> list[str]:
    """List the names of the stages that add to exported scenes."""
    return list(dict.fromkeys(stage.name for line in pipelines.values() for stage in line if stage.is_post_export))
