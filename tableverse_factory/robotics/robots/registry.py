"""Arms by name: built-in arms, MuJoCo Menagerie models, and MJCF files."""

import importlib
from collections.abc import Callable, Mapping
from functools import lru_cache
from pathlib import Path

import numpy as np

from schemas.geometry import Vector3
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.arm_file import load_arm_file
from tableverse_factory.robotics.robots.panda import build_panda

ARMS: Mapping[str, Callable[[], Arm]] = {"panda": build_panda}  # built-in arms
MENAGERIE_PREFIX = "menagerie:"
# Body and position of the TCP in its frame, for models without a site `tcp` [m]
MENAGERIE_TCPS: Mapping[str, tuple[str, Vector3]] = {"franka_emika_panda": ("hand", np.array([0.0, 0.0, 0.1034]))}


@lru_cache(maxsize=8)
def load_arm(name: str) -> Arm:
    """Load the arm `panda`, `menagerie:NAME`, or the file `….xml`; a file that changes later is not read again."""
    if name in ARMS:
        return ARMS[name]()
    if name.startswith(MENAGERIE_PREFIX):
        return _load_menagerie_arm(name)
    if name.endswith(".xml"):
        return load_arm_file(Path(name).absolute(), name)
    known = ", ".join(repr(known) for known in ARMS)
    raise ConfigError(f"no robot {sanitize_line(name, 80)!r}: give {known}, '{MENAGERIE_PREFIX}NAME' or a file '….xml'")


def _load_menagerie_arm(name: str) -> Arm:
    """Load a model's default file, which the package fetches on first use."""
    model = name.removeprefix(MENAGERIE_PREFIX)
    try:
        menagerie = importlib.import_module("mujoco_menagerie")
    except ImportError:
        raise ConfigError(f"robot {name!r} needs a package: pip install 'tableverse-factory[robots]'") from None
    try:
        robot = menagerie.get(model)
        path = Path(robot.xml(robot.default_model))
    except (menagerie.MenagerieError, OSError) as error:
        raise ConfigError(f"robot {sanitize_line(name, 80)!r}: {sanitize_line(str(error), 400)}") from error
    return load_arm_file(path, name, MENAGERIE_TCPS.get(model))
