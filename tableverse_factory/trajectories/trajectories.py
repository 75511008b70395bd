"""TRAJECTORIES: a proven motion for every accepted task of an exported scene."""

import numpy as np

from schemas.config import Config
from schemas.outcome import Done, Outcome
from schemas.scene import ExportedScene
from tableverse_factory.services import Services


def trajectories(
    scene: ExportedScene,
    config: Config,  # noqa: ARG001
    rng: np.random.Generator,  # noqa: ARG001
    services: Services,  # noqa: ARG001
) -> Outcome[ExportedScene]:
    """The scene as it is: no task is tried yet, so there is no row of one."""
    return Done(scene)
