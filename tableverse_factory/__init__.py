"""TableVerse Factory: table-top pictures become simulation-ready, certified MuJoCo scenes."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tableverse_factory.dataset.dataset import Dataset, Scene, open_dataset

__version__ = "0.7.1"
__all__ = ["Dataset", "Scene", "__version__", "open_dataset"]


def __getattr__(name: str) -> Any:
    """Loads what consumers import on first use, so that importing the package stays cheap."""
    if name not in {"Dataset", "Scene", "open_dataset"}:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from tableverse_factory.dataset import dataset

    return getattr(dataset, name)
