"""Every bad mesh is repaired, with a word for how, or refused, with a reason; and none takes long."""

import os
import time
from pathlib import Path

import numpy as np
import pytest

from schemas.config import RectifyConfig
from schemas.geometry import TriangleMesh
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.convex.decompose import decompose
from tableverse_factory.geometry.mesh.repair import make_closed_solid, solid_to_mesh
from tests.helpers.bad_meshes import BAD_MESHES, LARGE_MESHES, BadMesh

pytestmark = pytest.mark.heavy

CONFIG = RectifyConfig()
SLOW = (
    "needles",
    "klein_bottle",
    "bottomless_bowl",
    "three_hundred_shells",
)  # others have their faults
REFUSED_FOR_THEIR_SIZE = ("three_micrometres", "forty_metres")  # by the stage, which knows that this is a table


def ended(bad: BadMesh, mesh: TriangleMesh, cache: Path) -> str:
    """How it was repaired, or `refused`; what comes out is sound."""
    try:
        pieces = decompose(mesh, CONFIG, cache)
    except GeometryError:
        return "refused"
    assert 1 <= len(pieces.hulls) <= CONFIG.max_pieces
    size = np.ptp(mesh.vertices[np.unique(mesh.faces)], axis=0).max()
    corners = np.concatenate([hull.vertices for hull in pieces.hulls])
    assert np.isfinite(corners).all()
    assert np.abs(np.ptp(corners, axis=0).max() / size - 1.0) < 0.1
    assert pieces.uncovered_m < 0.02 * size
    most = 1.01 * (1.0 + CONFIG.volume_error)  # simplified, what is cut has another volume by as much as 1 %
    assert pieces.volume_ratio <= most or len(pieces.hulls) == CONFIG.max_pieces
    return pieces.repaired


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in BAD_MESHES]
)
def test_a_bad_mesh_is_repaired_or_refused(name: str, tmp_path: Path) -> None:
    bad = BAD_MESHES[name]
    assert ended(bad, bad.make(), tmp_path) in (bad.ends if name not in REFUSED_FOR_THEIR_SIZE else {""})


@pytest.mark.slow
@pytest.mark.parametrize("name", LARGE_MESHES)
def test_two_million_faces_take_seconds(name: str, tmp_path: Path) -> None:
    bad = LARGE_MESHES[name]
    mesh = bad.make()
    started = os.times()
    assert ended(bad, mesh, tmp_path) in bad.ends
    assert os.times().user - started.user < 60.0


@pytest.mark.parametrize("name", ["open_bowl", "bottomless_bowl"])
def test_an_open_bowl_stays_open_and_its_hole_too(name: str) -> None:
    solid = solid_to_mesh(make_closed_solid(BAD_MESHES[name].make())[0])
    on_axis = np.linalg.norm(solid.vertices[:, :2], axis=1) < 0.006
    assert on_axis.any() == (name == "open_bowl")
    assert solid.vertices[on_axis, 2].max(initial=0.0) < 0.01  # a foot, and no lid


def test_thousands_of_shells_do_not_compare_each_with_each(tmp_path: Path) -> None:
    cells = np.stack(np.meshgrid(*[np.arange(8)] * 3), axis=-1).reshape(-1, 3) * 0.01
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]) * 0.0095
    faces = np.array(
        [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6], [0, 2, 6]]
    )
    faces = np.concatenate([faces, [[0, 6, 4], [1, 5, 7], [1, 7, 3]]])
    vertices = (cells[:, None] + corners).reshape(-1, 3)
    every = (8 * np.arange(len(cells))[:, None, None] + faces).reshape(-1, 3).astype(np.int32)
    started = time.process_time()
    pieces = decompose(TriangleMesh(vertices, every), CONFIG, tmp_path)
    assert len(pieces.hulls) <= CONFIG.max_pieces
    assert time.process_time() - started < 30.0
