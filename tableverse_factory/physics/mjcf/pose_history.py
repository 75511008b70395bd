"""Where the objects of one of our scenes were before their XML was written."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from schemas.geometry import Pose


@dataclass(frozen=True, slots=True)
class History:
    """What is known about the objects of one of our scenes beyond its XML, by object id.

    Attributes:
        placed: Poses as the picture or the layout file put them; copies of a content have none.
        rectified: Poses after rectification, before settling.
        contained_in: Container of each object that was placed in one.
    """

    placed: Mapping[str, Pose] = field(default_factory=dict)
    rectified: Mapping[str, Pose] = field(default_factory=dict)
    contained_in: Mapping[str, str] = field(default_factory=dict)
