"""What a stage is: a pure function with its declared needs. Executors read the declaration and obey."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from schemas.config import Config
from schemas.manifest import SceneKind
from schemas.outcome import Outcome
from tableverse_factory.services import Services

Pool = Literal["perception", "geometry", "physics", "curation"]

StageFunction = Callable[[Any, Config, np.random.Generator, Services], Outcome[Any]]


@dataclass(frozen=True, slots=True)
class Stage:
    """One step of the line.

    Attributes:
        name: Also the name of its section in the configuration, and of its random stream.
        pool: Which actors run it.
        run: `run(item, config, rng, services) -> Outcome`. Pure: no clock, no global state, no other randomness.
    """

    name: str
    pool: Pool
    run: StageFunction


Lines = Mapping[SceneKind, Sequence[Stage]]
"""The stages that an entry of each kind runs through, in order."""
