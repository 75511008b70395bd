"""The judges `openai` and `gemini`: a model sees two views of the scene and gives the seven outputs."""

import io

from PIL import Image

from schemas.config import CurateConfig
from schemas.curation import AnswerOrigin
from tableverse_factory.models.remote.client import ModelClient
from tableverse_factory.models.remote.endpoint import read_endpoint
from tableverse_factory.models.services import Services
from tableverse_factory.physics.mjcf.scenery import make_scenery
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.render.views import draw_judge_sheet
from tableverse_factory.stages.curate.interfaces import Judgement
from tableverse_factory.stages.curate.judge_input import JudgeInput
from tableverse_factory.stages.curate.parse_answer import parse_judgement
from tableverse_factory.stages.curate.prompt import PROMPT_SHA256, build_judge_prompt, build_judge_schema

_JPEG_QUALITY = 92


class ModelJudge:
    """Asks the model that the configuration names; its answers are cached."""

    def __init__(self, config: CurateConfig, services: Services) -> None:
        self._model = config.model
        self._client = ModelClient(read_endpoint(config), services)

    def judge(self, case: JudgeInput) -> Judgement:
        """Ask the model about the scene; raises as `ModelClient.ask`."""
        prompt, schema = build_judge_prompt([item.label for item in case.items]), build_judge_schema(len(case.items))
        reply = self._client.ask_for(parse_judgement, prompt, [_encode_views(case)], schema)
        origin = AnswerOrigin(model=self._model, prompt_sha256=PROMPT_SHA256, rounds=reply.rounds)
        return Judgement(reply.value, reply.text, origin)


def _encode_views(case: JudgeInput) -> bytes:
    """Render both views with boxes, numbers and labels as one JPEG."""
    table = case.table
    slab = Slab(table.center_xy, table.half_size_xy, table.yaw, table.color)
    scenery = make_scenery([item.object_id for item in case.items], [item.mesh for item in case.items], slab)
    data = io.BytesIO()
    sheet = Image.fromarray(draw_judge_sheet(scenery, [item.label for item in case.items]))
    sheet.save(data, "JPEG", quality=_JPEG_QUALITY, subsampling=0)  # colours at full resolution keep tags legible
    return data.getvalue()
