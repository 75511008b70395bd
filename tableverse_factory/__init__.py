"""TableVerse Factory: table-top pictures become simulation-ready, certified MuJoCo scenes."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tableverse_factory.core.version import __version__

if TYPE_CHECKING:
    from tableverse_factory.dataset.dataset import Dataset, open_dataset
    from tableverse_factory.dataset.scene import Scene
    from tableverse_factory.delivery.learning import (
        SceneDataset,
        SceneGrid,
        SceneStream,
        TableEnv,
        Variation,
        VectorSim,
        build_scene_grid,
    )

__all__ = [
    "Dataset",
    "Scene",
    "SceneDataset",
    "SceneGrid",
    "SceneStream",
    "TableEnv",
    "Variation",
    "VectorSim",
    "__version__",
    "build_scene_grid",
    "open_dataset",
]

_DATASET = {"Dataset", "Scene", "open_dataset"}


def __getattr__(name: str) -> Any:
    """Import a public name on first use, so that importing the package stays cheap."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    home = "dataset.dataset" if name in _DATASET else "delivery.learning"
    return getattr(import_module(f"{__name__}.{home}"), name)
