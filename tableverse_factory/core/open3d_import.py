"""Import of Open3D without its plotting packages, which bring a web server."""

import sys
from types import ModuleType

_PLOT_MODULES = ("dash", "plotly", "plotly.graph_objects")


class _StubModule(ModuleType):
    """A module from which any name can be imported, as a plain object."""

    def __getattr__(self, name: str) -> object:
        if name.startswith("__"):
            raise AttributeError(name)
        return object


def stub_plotly() -> None:
    """Keep Open3D from importing Dash and plotly, half of its import time, in processes of this package alone."""
    for name in _PLOT_MODULES:
        sys.modules.setdefault(name, _StubModule(name))
