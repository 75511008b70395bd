"""The line of `asking_line`, whose first question kills the process that asks it."""

import os
import signal
from dataclasses import replace

from schemas.manifest import SceneKind
from tests.helpers.asking_line import PIPELINES as ASKING


def perceive(item, config, rng, services):
    services.meter.add_request()
    os.kill(os.getpid(), getattr(signal, item["name"]))


_STAGES = tuple(
    replace(stage, run=perceive) if stage.name == "perceive" else stage for stage in ASKING[SceneKind.IMAGE]
)
PIPELINES = dict.fromkeys(SceneKind, _STAGES)
