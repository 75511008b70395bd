"""What a stage is: a pure function with its declared needs. Executors read the declaration and obey."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from schemas.config import Config
from schemas.manifest import SceneKind
from schemas.outcome import Outcome
from tableverse_factory.models.services import Services

Pool = Literal["perception", "geometry", "physics", "curation", "trajectories"]

StageFunction = Callable[[Any, Config, np.random.Generator, Services], Outcome[Any]]


@dataclass(frozen=True, slots=True)
class Stage:
    """One step of the line.

    Attributes:
        name: Also the name of its random stream.
        pool: Which actors run it.
        run: `run(item, config, rng, services) -> Outcome`. Pure: no clock, no global state, no other randomness.
        reads: What it reads of the configuration, as `section` or `section.key`; the first is its own section. A
            change of anything else leaves what it gave valid.
        adds: Whether it takes an exported scene and gives it back with more to it. Where such a stage fails, the scene
            stays done as it came in, and rows say what failed.
    """

    name: str
    pool: Pool
    run: StageFunction
    reads: tuple[str, ...]
    adds: bool = False

    @property
    def section(self) -> str:
        """Its own section of the configuration, which also holds its deadline."""
        return self.reads[0].partition(".")[0]

    def values(self, config: Config) -> dict[str, Any]:
        """What it reads of a configuration, by dotted key; its deadline decides no record."""
        tree = config.model_dump(mode="json")
        found: dict[str, Any] = {}
        for name in self.reads:
            section, _, key = name.partition(".")
            keys = [key] if key else [key for key in tree[section] if key != "deadline_s"]
            found |= {f"{section}.{key}": tree[section][key] for key in keys}
        return found


Pipelines = Mapping[SceneKind, Sequence[Stage]]
"""The stages that an entry of each kind runs through, in order."""
