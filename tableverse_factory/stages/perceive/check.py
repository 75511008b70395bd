"""Check of the detector's and the segmenter's models before a build."""

from collections.abc import Collection

from schemas.config import Config
from schemas.manifest import SceneKind
from tableverse_factory.models.local.preflight import check_weights
from tableverse_factory.models.picture.net import check_picture_net


def check_perception_models(config: Config, kinds: Collection[SceneKind], here: bool) -> None:
    """Check the models of the detector and the segmenter; WeightsError if one cannot be loaded."""
    own = config.perceive
    by_net = own.detector == "auto" and not {SceneKind.IMAGE, SceneKind.CAPTURE}.isdisjoint(kinds)
    if by_net or own.detector in ("picture", "ensemble") or own.segmenter == "picture":
        check_picture_net(own.detector_weights, "perceive.detector_weights")
    if own.detector == "grounding_dino":
        check_weights("perceive.detector_weights", own.detector, own.detector_weights, config.models, here)
    if own.segmenter in ("sam2", "sam3"):
        check_weights("perceive.segmenter_weights", own.segmenter, own.segmenter_weights, config.models, here)
