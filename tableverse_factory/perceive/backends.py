"""Which backend stands behind which name."""

from tableverse_factory.perceive.doors import BoxSegmenter, Detector
from tableverse_factory.perceive.geometric import geometric, geometric_boxes
from tableverse_factory.perceive.replay import replay

DETECTORS: dict[str, Detector] = {"geometric": geometric, "replay": replay}
BOX_SEGMENTERS: dict[str, BoxSegmenter] = {"geometric": geometric_boxes}
