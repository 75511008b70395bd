"""What is between the fingers."""

from dataclasses import dataclass

from schemas.geometry import Frozen, Pose


@dataclass(frozen=True, slots=True, eq=False)
class CarriedObject(Frozen):
    """An object between the fingers, which follows the TCP.

    Attributes:
        object_id: Which.
        object_to_tcp: The object's own frame in the gripper frame.
    """

    object_id: str
    object_to_tcp: Pose
