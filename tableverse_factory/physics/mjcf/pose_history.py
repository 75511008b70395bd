"""Earlier poses of the objects of an exported scene."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from schemas.geometry import Pose


@dataclass(frozen=True, slots=True)
class PoseHistory:
    """Facts about the objects of an exported scene that its XML does not hold, by object id.

    Attributes:
        placed: Poses from the picture or the layout file; copies of a content have none.
        rectified: Poses after rectification, before settling.
        contained_in: Container of each object that was placed in one.
    """

    placed: Mapping[str, Pose] = field(default_factory=dict)
    rectified: Mapping[str, Pose] = field(default_factory=dict)
    contained_in: Mapping[str, str] = field(default_factory=dict)
