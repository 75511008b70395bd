"""Arms by name."""

from collections.abc import Callable, Mapping

from tableverse_factory.errors import ConfigError
from tableverse_factory.robots.arm import Arm
from tableverse_factory.robots.panda import panda
from tableverse_factory.text import printable

ARMS: Mapping[str, Callable[[], Arm]] = {"panda": panda}
"""Arms that are written here."""


def arm_of(name: str) -> Arm:
    """The arm of this name.

    Raises:
        ConfigError: if there is none.
    """
    if name in ARMS:
        return ARMS[name]()
    raise ConfigError(f"robot {printable(name, 80)!r} is none: give {', '.join(map(repr, ARMS))}")
