"""Tables of detectors and box segmenters by the names in `perceive.detector` and `perceive.segmenter`."""

from functools import partial

from tableverse_factory.stages.perceive.base.interfaces import BoxSegmenter, Detector
from tableverse_factory.stages.perceive.base.replay import replay_detections
from tableverse_factory.stages.perceive.depth_segmenter.segment import detect_from_depth, segment_boxes_from_depth
from tableverse_factory.stages.perceive.ensemble.detector import detect_with_ensemble
from tableverse_factory.stages.perceive.grounding_dino.detector import detect_with_grounding_dino
from tableverse_factory.stages.perceive.picture.detector import detect_in_picture, segment_boxes_in_picture
from tableverse_factory.stages.perceive.sam.segmenter import segment_with_sam
from tableverse_factory.stages.perceive.vlm.detector import detect_with_vlm

DETECTORS: dict[str, Detector] = {
    "geometric": detect_from_depth,
    "ensemble": detect_with_ensemble,
    "picture": detect_in_picture,
    "replay": replay_detections,
    "grounding_dino": detect_with_grounding_dino,
    "openai": detect_with_vlm,
    "gemini": detect_with_vlm,
}
BOX_SEGMENTERS: dict[str, BoxSegmenter] = {
    "geometric": segment_boxes_from_depth,
    "picture": segment_boxes_in_picture,
    "sam2": partial(segment_with_sam, "sam2"),
    "sam3": partial(segment_with_sam, "sam3"),
}
