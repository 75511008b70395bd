"""Pipelines without work, or that only burn CPU, which leave the overhead of the factory itself.

A build names them `tableverse_factory.evaluation.bench.noop_pipeline:NOOP_PIPELINES` or `:BURNING_PIPELINES`. Stages
and pools are those of the default pipeline. A row whose name is a number of bytes gives a scene with so many, and
records with an array of that size from the first stage on.
"""

import json
import time
from collections.abc import Sequence
from typing import Any

import numpy as np

from schemas.config import Config
from schemas.manifest import ImageRow, SceneKind
from schemas.outcome import Done, Outcome
from schemas.scene import Certificate, ExportedScene
from tableverse_factory.stage import Pool, Stage

BURN_S = 0.02  # CPU time of each stage of the burning pipeline [s]
OBJECTS_PER_SCENE = 2
MESHES_PER_SCENE = 10  # files that a payload is cut into
_BLOCK_BYTES = 1_000_003  # of random bytes, which a payload repeats
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


def observe_payload(row: ImageRow, _config: Config, rng: np.random.Generator, *_: Any) -> Outcome[Any]:
    """Return the row, with as many random bytes as its name says."""
    if not row.name.isdecimal():
        return Done(row)
    block = rng.integers(0, 256, _BLOCK_BYTES, dtype=np.uint8)
    return Done({"row": row, "payload": np.resize(block, int(row.name))})


def pass_through(item: Any, *_: Any) -> Outcome[Any]:
    """Return the item."""
    return Done(item)


def burn_cpu(item: Any, *_: Any) -> Outcome[Any]:
    """Return the item after `BURN_S` of CPU time."""
    until = time.process_time() + BURN_S
    while time.process_time() < until:
        pass
    return Done(item)


def export_minimal(item: ImageRow | dict[str, Any], *_: Any) -> Outcome[ExportedScene]:
    """Return a minimal valid scene with rows in every table, and the payload as its meshes."""
    if isinstance(item, ImageRow):
        return Done(make_minimal_scene(item.scene_id))
    meshes = np.array_split(item["payload"], MESHES_PER_SCENE)
    files = [(f"assets/mesh_{number}.bin", mesh.tobytes()) for number, mesh in enumerate(meshes)]
    return Done(make_minimal_scene(item["row"].scene_id, files))


def make_minimal_scene(scene_id: str, meshes: Sequence[tuple[str, bytes]] = ()) -> ExportedScene:
    """Make a scene of one ball, with two rows of objects and one of tasks."""
    meta = json.dumps({"format": "tableverse-scene-1", "scene_id": scene_id, "objects": []}).encode()
    objects = tuple(
        {"scene_id": scene_id, "object_id": f"obj_{i:03d}", "label": "ball", "mass_kg": 0.1, "z_m": 0.5}
        for i in range(OBJECTS_PER_SCENE)
    )
    task = {"scene_id": scene_id, "task_id": "task_000", "instruction": "Lift the ball.", "accepted": True}
    row = {"n_objects": OBJECTS_PER_SCENE, "usable": True, "quality_score": 5, "drift_m": 0.0, "at_rest": True}
    files = (*meshes, ("meta.json", meta), ("scene.xml", (_XML % scene_id).encode()))
    return ExportedScene(scene_id, files, _CERTIFICATE, row, objects, (task,))


STAGES = (
    Stage(*_STAGES[0], observe_payload, reads=(_STAGES[0][0],)),
    *(Stage(name, pool, pass_through, reads=(name,)) for name, pool in _STAGES[1:-1]),
    Stage(*_STAGES[-1], export_minimal, reads=(_STAGES[-1][0],)),
)
NOOP_PIPELINES = {SceneKind.CAPTURE: STAGES}
BURNING_PIPELINES = {
    SceneKind.CAPTURE: (*(Stage(name, pool, burn_cpu, reads=(name,)) for name, pool in _STAGES[:-1]), STAGES[-1])
}
