"""MuJoCo's sleep: bodies at rest that no moving body touches are not simulated."""

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def allow_sleep(model: mujoco.MjModel, tolerance: float) -> Iterator[None]:
    """Let bodies slower than the tolerance [m/s, rad/s] for ten steps fall asleep, with those that they touch."""
    option = model.opt
    own = int(option.enableflags), float(option.sleep_tolerance)
    option.enableflags, option.sleep_tolerance = own[0] | int(mujoco.mjtEnableBit.mjENBL_SLEEP), tolerance
    try:
        yield
    finally:
        option.enableflags, option.sleep_tolerance = own
