"""The robot of a recording: what arrays name is neither opened nor fetched, unless the user names it too."""

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.robotics.execution.replay import named_arm
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.registry import ARMS, arm_of


def recorded_arm(recording: Recording, given: str | None = None) -> Arm:
    """The arm that made a recording.

    Args:
        recording: Its arrays; one of our own arms is known by its name in them.
        given: By the user, as in `robots.doors.arm_of`: the arm of those that came from a file or from the Menagerie.

    Raises:
        InputError: `robot_is_a_file` or `robot_not_given` for one that has to be given; `another_robot` for an arm
            that has other joints.
        ConfigError: if there is no arm of this name.
    """
    name = recording.robot
    if given is not None and name not in ARMS:
        arm = arm_of(given)
    elif ":" in name:
        raise InputError(f"its robot, {sanitize_line(name, 100)}, has to be given with --robot", "robot_not_given")
    else:
        arm = named_arm(name)
    joints, fingers = len(arm.home), len(arm.finger_closed)
    if (recording.command.shape[1], recording.qpos.shape[1]) != (joints + 1, joints + fingers):
        raise InputError(
            f"its arrays are of {recording.command.shape[1] - 1} joints, and {sanitize_line(arm.name, 100)} has {joints}, "
            f"with {fingers} of its gripper",
            "another_robot",
        )
    return arm
