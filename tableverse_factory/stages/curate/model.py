"""The judges `openai` and `gemini`: a model is shown both views of the scene and asked for the seven outputs."""

import io

from PIL import Image

from schemas.config import CurateConfig
from schemas.curation import AnswerOrigin
from tableverse_factory.models.remote.client import ModelClient
from tableverse_factory.models.remote.endpoint import endpoint_of
from tableverse_factory.models.services import Services
from tableverse_factory.physics.mjcf.drawables import make_scenery
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.render.views import draw_judge_sheet
from tableverse_factory.stages.curate.answer_schema import build_judge_schema
from tableverse_factory.stages.curate.judge_input import JudgeInput
from tableverse_factory.stages.curate.judgement import Judgement
from tableverse_factory.stages.curate.parse_answer import parse_judgement
from tableverse_factory.stages.curate.prompt import PROMPT_SHA256, build_judge_prompt

_JPEG_QUALITY = 92


class ModelJudge:
    """Asks the model that the configuration names; answers are kept in the cache."""

    def __init__(self, config: CurateConfig, services: Services) -> None:
        self._model = config.model
        self._client = ModelClient(endpoint_of(config), services)

    def judge(self, case: JudgeInput) -> Judgement:
        """The model's answer.

        Raises:
            AnswerInvalidError: if it is no answer, also after a round of repair, or the model refuses.
            ModelAccessError: if a person must act: key, permission, credit.
            ModelError: if the server does not answer.
        """
        labels = [item.label for item in case.items]
        schema = build_judge_schema(len(case.items))
        reply = self._client.ask_for(parse_judgement, build_judge_prompt(labels), [sheet_jpeg(case)], schema)
        origin = AnswerOrigin(model=self._model, prompt_sha256=PROMPT_SHA256, rounds=reply.rounds)
        return Judgement(reply.value, reply.text, origin)


def sheet_jpeg(case: JudgeInput) -> bytes:
    """The two views with boxes, numbers and labels, as the model gets them."""
    table = case.table
    slab = Slab(table.center_xy, table.half_size_xy, table.yaw, table.color)
    scenery = make_scenery([item.object_id for item in case.items], [item.mesh for item in case.items], slab)
    data = io.BytesIO()
    sheet = Image.fromarray(draw_judge_sheet(scenery, [item.label for item in case.items]))
    sheet.save(data, "JPEG", quality=_JPEG_QUALITY, subsampling=0)  # colours at full resolution keep tags legible
    return data.getvalue()
