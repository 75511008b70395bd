"""Which backend stands behind which name."""

from tableverse_factory.perceive.asked import asked
from tableverse_factory.perceive.doors import BoxSegmenter, Detector
from tableverse_factory.perceive.geometric import geometric, geometric_boxes
from tableverse_factory.perceive.learned import learned
from tableverse_factory.perceive.replay import replay
from tableverse_factory.perceive.sam import sam

DETECTORS: dict[str, Detector] = {
    "geometric": geometric,
    "learned": learned,
    "replay": replay,
    "openai": asked,
    "gemini": asked,
}
BOX_SEGMENTERS: dict[str, BoxSegmenter] = {"geometric": geometric_boxes, "sam2": sam("sam2"), "sam3": sam("sam3")}
