"""Deferred modules are the true ones for the library that names them, and are nothing to anyone else."""

import subprocess
import sys

import pytest

pytestmark = pytest.mark.heavy

PLOTS = """
import sys
import tableverse_factory.robotics.motion.retime
import toppra.algorithm.algorithm as ours
assert not {"matplotlib", "matplotlib.pyplot"} & sys.modules.keys(), "nobody has drawn"
from matplotlib.axes import Axes
import matplotlib
assert ours.plt.figure is matplotlib.pyplot.figure, "who draws has the true module"
assert Axes is matplotlib.axes.Axes
"""


def test_a_library_draws_its_plots_though_their_module_is_not_imported_with_it():
    subprocess.run([sys.executable, "-W", "ignore", "-c", PLOTS], check=True)


def test_a_module_that_is_there_already_is_not_replaced():
    """Nor is one left behind where the import fails."""
    code = """
import json, sys
from tableverse_factory.core.deferred_modules import defer_modules
try:
    with defer_modules("json", "wave"):
        assert sys.modules["json"] is json
        import wave
        raise ImportError
except ImportError:
    assert "wave" not in sys.modules
assert wave.open is __import__("wave").open
"""
    subprocess.run([sys.executable, "-c", code], check=True)
