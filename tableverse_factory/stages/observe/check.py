"""Check of the depth model before a build."""

from collections.abc import Collection

from schemas.config import Config
from schemas.manifest import SceneKind
from tableverse_factory.models.local.preflight import check_weights
from tableverse_factory.models.picture.net import check_picture_net
from tableverse_factory.stages.observe.depth.from_git import MOGE_CHECKPOINT, check_git_package

_KEY = "observe.depth_weights"
_GIT_PACKAGES = {
    "depth_anything_3": "depth_anything_3",
    "depth_anything_3_nested": "depth_anything_3",
    "moge_2": "moge",
}


def check_depth_model(config: Config, kinds: Collection[SceneKind], here: bool) -> None:
    """Check the depth model of bare pictures, if there are any; WeightsError if it cannot be loaded."""
    backend, weights = config.observe.depth, config.observe.depth_weights
    if SceneKind.IMAGE not in kinds or backend in ("sensor", "recorded"):
        return
    if backend == "picture":
        check_picture_net(weights, _KEY)
        return
    if here and backend in _GIT_PACKAGES:
        check_git_package(_GIT_PACKAGES[backend])
    pattern = {"pattern": MOGE_CHECKPOINT} if backend == "moge_2" else {}
    check_weights(_KEY, backend, weights, config.models, here, **pattern)
