"""The line of `asking_line`, whose first question kills the process that asks it."""

import os
import signal
from dataclasses import replace

from schemas.manifest import SceneKind
from tests.helpers.asking_line import LINES as ASKING


def perceive(item, config, rng, services):
    services.meter.ask()
    os.kill(os.getpid(), getattr(signal, item["name"]))


_STAGES = tuple(
    replace(stage, run=perceive) if stage.name == "perceive" else stage for stage in ASKING[SceneKind.IMAGE]
)
LINES = dict.fromkeys(SceneKind, _STAGES)
