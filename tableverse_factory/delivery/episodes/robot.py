"""Robot of a recording; a robot named in arrays is neither opened nor fetched unless the user names it too."""

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.robotics.execution.replay import load_named_arm
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.registry import ARMS, load_arm


def load_recorded_arm(recording: Recording, given: str | None = None) -> Arm:
    """Load the arm of a recording; `given` is the user's, for recordings whose robot is not built in."""
    name = recording.robot
    if given is not None and name not in ARMS:
        arm = load_arm(given)
    elif ":" in name:
        raise InputError(f"its robot, {sanitize_line(name, 100)}, has to be given with --robot", "robot_not_given")
    else:
        arm = load_named_arm(name)
    joints, fingers = len(arm.home), len(arm.finger_closed)
    if (recording.command.shape[1], recording.qpos.shape[1]) != (joints + 1, joints + fingers):
        raise InputError(
            f"its arrays have {recording.command.shape[1] - 1} joints, but {sanitize_line(arm.name, 100)} has {joints} "
            f"and {fingers} in its gripper",
            "another_robot",
        )
    return arm
