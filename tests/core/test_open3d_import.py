"""We load Open3D without the web server of its plots; whoever draws one has it."""

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
    assert run_import("import tableverse_factory.core.open3d_import") == ["1.0", "False"]


def find_web_server(_: int) -> bool:
    import tableverse_factory.geometry.mesh.height_maps  # noqa: F401 - the process of a pool imports it here

    return "werkzeug" in sys.modules


def test_processes_of_a_pool_load_no_web_server():
    assert list(parallel_map(find_web_server, [0, 1], 2, "imports")) == [False, False]


@pytest.mark.parametrize(
    "name", ["open3d", pytest.param("tableverse_factory.geometry.mesh.height_maps", marks=pytest.mark.slow)]
)
def test_plots_are_there_for_whoever_draws_them(name):
    """Each time, whoever imports first; and the packages that they bring are the true ones."""
    drawn = f"""
import {name}, tableverse_factory.core.open3d_import, open3d, dash
box = open3d.geometry.TriangleMesh.create_box()
for _ in range(2):
    figure = open3d.visualization.get_plotly_fig([box])
    assert (type(figure).__name__, len(figure.data)) == ("Figure", 1)
assert open3d.visualization.draw_plotly.__module__ == "open3d.visualization.draw_plotly"
assert dash.Dash.__module__ == "dash.dash"
"""
    assert run_import(drawn) == ["1.0", "True"]
