"""Open3D loads without the web server of its plots in our processes; importers of the library keep both."""

import subprocess
import sys

import pytest

from tableverse_factory.core.process_pool import parallel_map

pytestmark = pytest.mark.heavy

CAST = """
import numpy as np, open3d as o3d
scene = o3d.t.geometry.RaycastingScene()
corners = np.array([[-1, -1, 1], [1, -1, 1], [0, 1, 1]], np.float32)
scene.add_triangles(corners, np.array([[0, 1, 2]], np.uint32))
print(round(scene.cast_rays(np.array([[0, 0, 0, 0, 0, 1]], np.float32))["t_hit"].item(), 3), "werkzeug" in sys.modules)
"""


def run_import(before: str) -> list[str]:
    line = [sys.executable, "-W", "ignore", "-c", f"import sys\n{before}\n{CAST}"]
    return subprocess.run(line, check=True, capture_output=True, text=True).stdout.split()


def test_rays_hit_without_a_web_server_in_the_process():
    ours = run_import("from tableverse_factory.core.open3d_import import stub_plotly; stub_plotly()")
    assert ours == ["1.0", "False"]


def find_web_server(_: int) -> bool:
    import open3d  # noqa: F401 - the process of a pool imports it here

    return "werkzeug" in sys.modules


def test_processes_of_a_pool_load_no_web_server():
    assert list(parallel_map(find_web_server, [0, 1], 2, "imports")) == [False, False]


def test_importing_us_leaves_the_plots_of_others_alone():
    theirs = (
        "import tableverse_factory.geometry.mesh.height_maps, open3d, dash; assert dash.Dash.__module__ == 'dash.dash'"
    )
    assert run_import(theirs) == ["1.0", "True"]
