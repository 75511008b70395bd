"""Lines that do nothing, or nothing but burn CPU: what is left of a build's cost is the factory's own.

A build names them as `tableverse_factory.evaluation.bench.noop_pipeline:LINES` or `:BURNING`. Stages and pools are those of the real line.
"""

import json
import time
from typing import Any

import numpy as np

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done, Outcome
from schemas.scene import Certificate, ExportedScene
from tableverse_factory.models.services import Services
from tableverse_factory.stage import Pool, Stage

BURN_S = 0.02
"""CPU time of each stage of the burning line [s]."""
OBJECTS_PER_SCENE = 2
_STAGES: tuple[tuple[str, Pool], ...] = (
    ("observe", "perception"),
    ("perceive", "perception"),
    ("place", "geometry"),
    ("rectify", "geometry"),
    ("settle", "physics"),
    ("curate", "curation"),
    ("export", "physics"),
)
_BODY = '<body name="obj_000" pos="0 0 0.5"><freejoint/><geom size="0.02"/></body>'
_XML = f'<mujoco model="%s"><worldbody>{_BODY}</worldbody></mujoco>'
_CERTIFICATE = Certificate(0.001, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (), (), (), True, False)


def hand_on(item: Any, config: Config, rng: np.random.Generator, services: Services) -> Outcome[Any]:  # noqa: ARG001
    """Gives back what it was given."""
    return Done(item)


def burn(item: Any, config: Config, rng: np.random.Generator, services: Services) -> Outcome[Any]:  # noqa: ARG001
    """Gives back what it was given, `BURN_S` of CPU time later."""
    until = time.process_time() + BURN_S
    while time.process_time() < until:
        pass
    return Done(item)


def finish(row: ImageRow, config: Config, rng: np.random.Generator, services: Services) -> Outcome[ExportedScene]:  # noqa: ARG001
    """A scene as small as a valid one can be, with a row in every table."""
    return Done(small_scene(row.scene_id))


def small_scene(scene_id: str) -> ExportedScene:
    """One ball in the air, two rows of objects and one of tasks."""
    meta = json.dumps({"format": "tableverse-scene-1", "scene_id": scene_id, "objects": []}).encode()
    objects = tuple(
        {"scene_id": scene_id, "object_id": f"obj_{i:03d}", "label": "ball", "mass_kg": 0.1, "z_m": 0.5}
        for i in range(OBJECTS_PER_SCENE)
    )
    task = {"scene_id": scene_id, "task_id": "task_000", "instruction": "Lift the ball.", "accepted": True}
    row = {"n_objects": OBJECTS_PER_SCENE, "usable": True, "quality_score": 5, "drift_m": 0.0, "at_rest": True}
    files = (("meta.json", meta), ("scene.xml", (_XML % scene_id).encode()))
    return ExportedScene(scene_id, files, _CERTIFICATE, row, objects, (task,))


STAGES = (
    *(Stage(name, pool, hand_on, reads=(name,)) for name, pool in _STAGES[:-1]),
    Stage(*_STAGES[-1], finish, reads=(_STAGES[-1][0],)),
)
LINES = {SceneKind.CAPTURE: STAGES}
BURNING = {SceneKind.CAPTURE: (*(Stage(name, pool, burn, reads=(name,)) for name, pool in _STAGES[:-1]), STAGES[-1])}
