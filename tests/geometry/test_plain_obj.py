"""The quick reader of plain OBJ files gives what the slow one gives, and leaves to it whatever is not plain."""

from pathlib import Path

import numpy as np
import pytest

from tableverse_factory.geometry import meshes
from tableverse_factory.geometry.meshes import read_mesh
from tableverse_factory.geometry.plain_obj import read_plain_obj

CORNERS = b"v 0 0 0\nv 1 0 0\nv 0 1e-1 0\nv 0 0 -1\n"
FACES = b"f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.shared
def test_real_files_are_read_alike(shared_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for path in sorted((shared_dir / "meshes").glob("*.obj")):
        data = path.read_bytes()
        quick = read_plain_obj(data)
        assert quick is not None, path.name
        with monkeypatch.context() as patch:
            patch.setattr(meshes, "read_plain_obj", lambda _: None)
            slow = read_mesh(data, path.name)
        for name in ("vertices", "faces", "vertex_colors"):
            np.testing.assert_array_equal(getattr(quick, name), getattr(slow, name), path.name)


@pytest.mark.parametrize("end", [b"\n", b"\r\n"])
def test_a_tetrahedron(end: bytes) -> None:
    mesh = read_plain_obj((CORNERS + FACES).replace(b"\n", end))
    assert mesh is not None
    np.testing.assert_array_equal(mesh.vertices, [[0, 0, 0], [1, 0, 0], [0, 0.1, 0], [0, 0, -1]])
    np.testing.assert_array_equal(mesh.faces, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    assert mesh.vertex_colors is None


def test_colours_beside_the_corners_are_kept() -> None:
    mesh = read_plain_obj(b"v 0 0 0 1 0 0.5\nv 1 0 0 0 2 0\nv 0 1 0 0.2 0 -1\nf 1 2 3\n")
    assert mesh is not None
    assert mesh.vertex_colors is not None
    np.testing.assert_array_equal(mesh.vertex_colors, [[255, 0, 128], [0, 255, 0], [51, 0, 0]])


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"v 0 0 0\n",
        FACES,
        b"# a comment\n" + CORNERS + FACES,
        b"mtllib look.mtl\n" + CORNERS + FACES,
        CORNERS + b"vt 0 0\n" + FACES,
        CORNERS + FACES + CORNERS,
        CORNERS + b"f 1 2 3 4\n",
        CORNERS + b"f 1 2\nf 3 1 2 4\n",
        CORNERS + b"f 1/1 2/1 3/1\n",
        CORNERS + b"f -1 -2 -3\n",
        CORNERS + b"f 1 2 5\n",
        CORNERS + b"f 0 1 2\n",
        CORNERS + b"f 1 2 2.5\n",
        CORNERS + b"f 1 2 99999999999999999999\n",
        b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        b"v 0 0\nv 1 0 0 0\nv 0 1 0\nf 1 2 3\n",
        b"v 0 0 --1\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        b"v 0 0 0 0.5\nv 1 0 0 0.5\nv 0 1 0 0.5\nf 1 2 3\n",
    ],
)
def test_anything_else_is_left_alone(data: bytes) -> None:
    assert read_plain_obj(data) is None
