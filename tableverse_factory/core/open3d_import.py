"""Open3D without its plots, in processes of our own: they bring a web server that nobody asks here."""

import sys
from types import ModuleType

_PLOT_MODULES = ("dash", "plotly", "plotly.graph_objects")


class _StubModule(ModuleType):
    """A module from which anything can be imported, and nothing of use."""

    def __getattr__(self, name: str) -> object:
        if name.startswith("__"):
            raise AttributeError(name)
        return object


def stub_plotly() -> None:
    """Keeps Open3D, when it is imported, from importing Dash: half of its time, an eighth of all that a stage imports.

    Not for a process of somebody else's, who may want to plot.
    """
    for name in _PLOT_MODULES:
        sys.modules.setdefault(name, _StubModule(name))
