"""Kinematics of an arm by itself, from its base to its gripper."""

from functools import lru_cache

import mujoco

from tableverse_factory.robotics.motion.kinematics import KinematicChain, build_chain
from tableverse_factory.robotics.robots.registry import load_arm


@lru_cache(maxsize=8)
def load_chain(robot: str) -> KinematicChain:
    """Load the kinematic chain of an arm, named as in `load_arm`, from its base to its TCP."""
    arm = load_arm(robot)
    model = arm.spec().compile()
    tcp_site = int(mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, arm.tcp_site))
    return build_chain(model, arm.joint_names, 0, tcp_site, (arm.lower, arm.upper))
