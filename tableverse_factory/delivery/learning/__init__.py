"""Dataset access for learning: scene streams, vectorized simulation, and a Gymnasium environment."""

import importlib
from typing import TYPE_CHECKING, Any

from tableverse_factory.core.errors import ConfigError

if TYPE_CHECKING:
    from tableverse_factory.delivery.learning.environment import TableEnv
    from tableverse_factory.delivery.learning.grid import SceneGrid, build_scene_grid
    from tableverse_factory.delivery.learning.loader import SceneDataset
    from tableverse_factory.delivery.learning.stream import SceneStream
    from tableverse_factory.delivery.learning.variation import Variation
    from tableverse_factory.delivery.learning.vector_sim import VectorSim

__all__ = ["SceneDataset", "SceneGrid", "SceneStream", "TableEnv", "Variation", "VectorSim", "build_scene_grid"]

_HOMES = {
    "SceneGrid": "grid",
    "VectorSim": "vector_sim",
    "SceneDataset": "loader",
    "SceneStream": "stream",
    "TableEnv": "environment",
    "Variation": "variation",
    "build_scene_grid": "grid",
}
_INSTALL = {"torch": "pip install torch", "gymnasium": "pip install 'tableverse-factory[gym]'"}


def __getattr__(name: str) -> Any:
    """Loads each on first use: who streams pictures needs no gymnasium, and who simulates no torch."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = importlib.import_module(f"{__name__}.{_HOMES[name]}")
    except ModuleNotFoundError as error:
        if error.name not in _INSTALL:
            raise
        raise ConfigError(f"{name} needs {error.name}: {_INSTALL[error.name]}") from None
    return getattr(module, name)
