"""TableVerse Factory: table-top pictures become simulation-ready, certified MuJoCo scenes."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from tableverse_factory.core.version import __version__

if TYPE_CHECKING:
    from tableverse_factory.dataset.dataset import Dataset, open_dataset
    from tableverse_factory.dataset.scene import Scene
    from tableverse_factory.delivery.learning.attach import attach_scene, find_unfit_settings
    from tableverse_factory.delivery.learning.dataset_environment import DatasetEnv
    from tableverse_factory.delivery.learning.dm_control import attach_to_dm_control
    from tableverse_factory.delivery.learning.environment import TableEnv
    from tableverse_factory.delivery.learning.grid import SceneGrid, build_scene_grid
    from tableverse_factory.delivery.learning.loader import SceneDataset
    from tableverse_factory.delivery.learning.mjx import load_mjx_spec
    from tableverse_factory.delivery.learning.newton import add_to_newton
    from tableverse_factory.delivery.learning.robosuite import add_to_robosuite
    from tableverse_factory.delivery.learning.sapien import add_to_sapien
    from tableverse_factory.delivery.learning.stream import SceneStream
    from tableverse_factory.delivery.learning.variation import Variation
    from tableverse_factory.delivery.learning.vector_sim import VectorSim
    from tableverse_factory.delivery.learning.warp import WarpBatch

__all__ = [
    "Dataset",
    "DatasetEnv",
    "Scene",
    "SceneDataset",
    "SceneGrid",
    "SceneStream",
    "TableEnv",
    "Variation",
    "VectorSim",
    "WarpBatch",
    "__version__",
    "add_to_newton",
    "add_to_robosuite",
    "add_to_sapien",
    "attach_scene",
    "attach_to_dm_control",
    "build_scene_grid",
    "find_unfit_settings",
    "load_mjx_spec",
    "open_dataset",
]

_MODULES = {
    "Dataset": "dataset.dataset",
    "DatasetEnv": "delivery.learning.dataset_environment",
    "Scene": "dataset.scene",
    "SceneDataset": "delivery.learning.loader",
    "SceneGrid": "delivery.learning.grid",
    "SceneStream": "delivery.learning.stream",
    "TableEnv": "delivery.learning.environment",
    "Variation": "delivery.learning.variation",
    "VectorSim": "delivery.learning.vector_sim",
    "WarpBatch": "delivery.learning.warp",
    "add_to_newton": "delivery.learning.newton",
    "add_to_robosuite": "delivery.learning.robosuite",
    "add_to_sapien": "delivery.learning.sapien",
    "load_mjx_spec": "delivery.learning.mjx",
    "attach_scene": "delivery.learning.attach",
    "attach_to_dm_control": "delivery.learning.dm_control",
    "build_scene_grid": "delivery.learning.grid",
    "find_unfit_settings": "delivery.learning.attach",
    "open_dataset": "dataset.dataset",
}
_INSTALL = {"torch": "pip install torch", "gymnasium": "pip install 'tableverse-factory[gym]'"}


def __getattr__(name: str) -> Any:
    """Import a public name on first use: the package stays cheap to import, and extras are needed only where used."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    try:
        module = import_module(f"{__name__}.{_MODULES[name]}")
    except ModuleNotFoundError as error:
        if error.name not in _INSTALL:
            raise
        from tableverse_factory.core.errors import ConfigError

        raise ConfigError(f"{name} needs {error.name}: {_INSTALL[error.name]}") from None
    return getattr(module, name)
