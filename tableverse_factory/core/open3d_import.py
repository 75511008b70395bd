"""Open3D without the web server of its plots, half of its import time, which comes when the first plot is drawn."""

import sys
from functools import partial
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

_PLOTS = "open3d.visualization.draw_plotly"
_FUNCTIONS = ("get_plotly_fig", "draw_plotly", "draw_plotly_server")


def _draw(name: str, *arguments: Any, **options: Any) -> Any:
    """Import the plots, put their functions where Open3D has them, and call one."""
    plots = import_module(_PLOTS)
    vars(sys.modules["open3d.visualization"]).update({name: getattr(plots, name) for name in _FUNCTIONS})
    return getattr(plots, name)(*arguments, **options)


def _import_open3d() -> ModuleType:
    if "open3d" not in sys.modules:
        sys.modules[_PLOTS] = ModuleType(_PLOTS)
        vars(sys.modules[_PLOTS]).update({name: partial(_draw, name) for name in _FUNCTIONS})
        try:
            return import_module("open3d")
        finally:
            del sys.modules[_PLOTS]
    return sys.modules["open3d"]


if TYPE_CHECKING:
    import open3d as o3d
else:
    o3d = _import_open3d()

__all__ = ["o3d"]
