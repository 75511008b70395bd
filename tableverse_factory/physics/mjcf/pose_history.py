"""Earlier poses of the objects of an exported scene."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from schemas.geometry import Pose


@dataclass(frozen=True, slots=True)
class PoseHistory:
    """Poses as placed (copies have none) and as rectified, before settling, and containers, by object id."""

    placed: Mapping[str, Pose] = field(default_factory=dict)
    rectified: Mapping[str, Pose] = field(default_factory=dict)
    contained_in: Mapping[str, str] = field(default_factory=dict)
