"""A pipeline of four tiny stages, two of which ask a model: what a row is named goes into both questions."""

import time

from schemas.manifest import SceneKind
from schemas.outcome import Done, Dropped
from schemas.scene import Certificate, ExportedScene
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.remote.client import ModelClient
from tableverse_factory.models.remote.endpoint import read_endpoint
from tableverse_factory.stage import Stage

SCHEMA = {"type": "object", "properties": {"a": {"type": "integer"}}, "required": ["a"], "additionalProperties": False}


def look(row, config, rng, services):
    return Done({"scene_id": row.scene_id, "name": row.name})


def perceive(item, config, rng, services):
    return _asked("perceive", item, config.perceive, services)


def judge(item, config, rng, services):
    return _asked("curate", item, config.curate, services)


def pack(item, config, rng, services):
    if item["name"].startswith("slow"):
        time.sleep(1.0)
    scene_id = item["scene_id"]
    files = (("scene.xml", f"<mujoco model='{item['perceive']} {item['curate']}'/>".encode()),)
    certificate = Certificate(0.001, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (), (), (), True, False)
    return Done(ExportedScene(scene_id, files, certificate, {"perception": "asked"}, (), ()))


def _asked(stage, item, section, services):
    if not section.protocol:
        return Done({**item, stage: 0})
    try:
        answer = ModelClient(read_endpoint(section), services).ask(f"{stage} {item['name']}", [], SCHEMA)
    except AnswerInvalidError as error:
        return Dropped(error.reason, str(error))
    return Done({**item, stage: answer["a"]})


_STAGES = (
    Stage("observe", "perception", look, reads=("observe",)),
    Stage("perceive", "perception", perceive, reads=("perceive",)),
    Stage("curate", "curation", judge, reads=("curate",)),
    Stage("export", "physics", pack, reads=("export",)),
)
PIPELINES = {SceneKind.CAPTURE: _STAGES, SceneKind.IMAGE: _STAGES, SceneKind.LAYOUT: _STAGES}
