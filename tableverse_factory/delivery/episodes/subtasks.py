"""Subtasks of a pick and place: the phases of recordings, and an estimate of them where nobody planned."""

from schemas.trajectories import Phase

SUBTASKS = {phase: phase.value.replace("_", "-") for phase in Phase}
"""Each phase in words, in order."""
_NEAR_M = 0.11  # from the gripper to the object's center of mass, within which it is about to be grasped
_RAISED_M = 0.002  # of the object, from which the fingers carry it
_ABOVE_M = 0.02  # horizontally from where it stood, within which it is still being raised
_SLOW = 0.03  # horizontal speed of the object, below which it is being set down [m/s]


def estimate_phase(lifted: bool, fingers: int, reach_m: float, rise_m: float, moved_m: float, speed: float) -> Phase:
    """Estimate the phase that a state belongs to.

    Args:
        lifted: Whether the object has ever been lifted.
        fingers: Fingers that touch it.
        reach_m: From the gripper to its center of mass [m].
        rise_m: Of its center since the start [m].
        moved_m: Its horizontal displacement since then [m].
        speed: Its horizontal speed [m/s].
    """
    if lifted and fingers == 0:
        return Phase.POST_PLACE
    if fingers == 2 and rise_m > _RAISED_M and moved_m < _ABOVE_M:
        return Phase.POST_GRASP
    if lifted:
        return Phase.PLACE if speed < _SLOW else Phase.PRE_PLACE
    return Phase.GRASP if reach_m < _NEAR_M else Phase.PRE_GRASP
