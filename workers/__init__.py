"""Builds of datasets on one process or a Ray cluster; `workers.build` runs one from Python."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from workers.api import build
    from workers.run import BuildSummary

__all__ = ["BuildSummary", "build"]


def __getattr__(name: str) -> Any:
    """Import the public names on first use: `import workers` alone stays cheap."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from workers import api

    return getattr(api, name)
