"""Which backend stands behind which name."""

from tableverse_factory.stages.perceive.base.interfaces import BoxSegmenter, Detector
from tableverse_factory.stages.perceive.base.replay import replay_detections
from tableverse_factory.stages.perceive.depth_segmenter.segment import detect_from_depth, segment_boxes_from_depth
from tableverse_factory.stages.perceive.learned.detector import detect_with_network
from tableverse_factory.stages.perceive.sam.segmenter import sam
from tableverse_factory.stages.perceive.vlm.detector import detect_with_vlm

DETECTORS: dict[str, Detector] = {
    "geometric": detect_from_depth,
    "learned": detect_with_network,
    "replay": replay_detections,
    "openai": detect_with_vlm,
    "gemini": detect_with_vlm,
}
BOX_SEGMENTERS: dict[str, BoxSegmenter] = {
    "geometric": segment_boxes_from_depth,
    "sam2": sam("sam2"),
    "sam3": sam("sam3"),
}
