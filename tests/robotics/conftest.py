"""The gripper that grasps are for."""

import pytest

from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.panda import build_panda


@pytest.fixture(scope="session")
def arm() -> Arm:
    return build_panda()
