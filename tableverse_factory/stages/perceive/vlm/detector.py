"""The detectors `openai` and `gemini`: a model at an address names and boxes the objects in the picture."""

import io

import numpy as np
from PIL import Image

from schemas.config import Config, PerceiveConfig
from schemas.curation import AnswerOrigin
from schemas.detection import DetectionRecord
from schemas.geometry import Picture
from schemas.outcome import Dropped
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.remote.client import ModelClient
from tableverse_factory.models.remote.endpoint import read_endpoint
from tableverse_factory.models.services import Services
from tableverse_factory.stages.perceive.base.interfaces import DetectionResult
from tableverse_factory.stages.perceive.base.replay import to_detection_result
from tableverse_factory.stages.perceive.base.table_view import TableView
from tableverse_factory.stages.perceive.vlm.boxes import ImageSize
from tableverse_factory.stages.perceive.vlm.parse_answer import parse_detections
from tableverse_factory.stages.perceive.vlm.postprocess import NO_TABLE, AnswerByRules, apply_rules
from tableverse_factory.stages.perceive.vlm.prompt import (
    build_detection_prompt,
    build_detection_schema,
    choose_box_order,
    hash_detection_prompt,
)

# Bounds of the longer side of the picture sent: above 1000, boxes in pixels differ from normalised ones
MIN_SIDE_PX, MAX_SIDE_PX = 1280, 1536
_JPEG_QUALITY = 92


def detect_with_vlm(view: TableView, config: Config, services: Services) -> DetectionResult | Dropped:
    """Detect boxes with the model, by the rules of the paper's appendix A.

    Drops: `detector_answer_invalid` (no usable answer, also after a round of repair), `detector_answer_refused` (the
    model refuses this picture), `no_table_detected`.
    """
    try:
        record = request_detections(view.observation.color, config.perceive, services)
    except AnswerInvalidError as error:
        return Dropped(NO_TABLE if error.reason == NO_TABLE else f"detector_{error.reason}", str(error))
    found = to_detection_result(record.answer, None, view.valid.shape)
    if found.table_box is None:
        lost = [remark.detail for remark in record.remarks if remark.rule == "behind_person"]
        return Dropped(NO_TABLE, f"{config.perceive.model} sees no table-top" + (f": {lost[-1]}" if lost else ""))
    return DetectionResult(found.candidates, found.table_box, record=record)


def request_detections(color: Picture, config: PerceiveConfig, services: Services) -> DetectionRecord:
    """Request the model's answer for a picture and apply the rules; without a table it is unusable."""
    order = choose_box_order(config)
    picture, sent = encode_image(color)

    def read(text: str) -> AnswerByRules:
        return apply_rules(parse_detections(text, order, sent))

    client = ModelClient(read_endpoint(config), services)
    reply = client.ask_for(read, build_detection_prompt(order), [picture], build_detection_schema(order))
    origin = AnswerOrigin(model=config.model, prompt_sha256=hash_detection_prompt(order), rounds=reply.rounds)
    answer, remarks = reply.value
    return DetectionRecord(origin=origin, answer=answer, remarks=remarks)


def encode_image(color: Picture) -> tuple[bytes, ImageSize]:
    """Encode the picture as JPEG, its longer side within the bounds; also return its width and height."""
    picture = Image.fromarray(np.ascontiguousarray(color))
    longer = max(picture.size)
    wanted = min(max(longer, MIN_SIDE_PX), MAX_SIDE_PX)
    if wanted != longer:
        width, height = (max(1, round(side * wanted / longer)) for side in picture.size)
        picture = picture.resize((width, height), Image.Resampling.LANCZOS)
    data = io.BytesIO()
    picture.save(data, "JPEG", quality=_JPEG_QUALITY)
    return data.getvalue(), picture.size
