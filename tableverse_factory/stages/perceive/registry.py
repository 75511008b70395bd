"""Which backend stands behind which name."""

from tableverse_factory.stages.perceive.base.interfaces import BoxSegmenter, Detector
from tableverse_factory.stages.perceive.base.replay import replay
from tableverse_factory.stages.perceive.depth_segmenter.segment import geometric, geometric_boxes
from tableverse_factory.stages.perceive.learned.detector import learned
from tableverse_factory.stages.perceive.sam.segmenter import sam
from tableverse_factory.stages.perceive.vlm.detector import detect_with_vlm

DETECTORS: dict[str, Detector] = {
    "geometric": geometric,
    "learned": learned,
    "replay": replay,
    "openai": detect_with_vlm,
    "gemini": detect_with_vlm,
}
BOX_SEGMENTERS: dict[str, BoxSegmenter] = {"geometric": geometric_boxes, "sam2": sam("sam2"), "sam3": sam("sam3")}
