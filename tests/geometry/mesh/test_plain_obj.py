"""The quick reader of plain OBJ files gives what the slow one gives, and leaves to it whatever is not plain."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.mesh import meshes, plain_obj
from tableverse_factory.geometry.mesh.meshes import read_mesh
from tableverse_factory.geometry.mesh.plain_obj import read_plain_obj

CORNERS = b"v 0 0 0\nv 1 0 0\nv 0 1e-1 0\nv 0 0 -1\n"
FACES = b"f 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def assert_read_alike(data: bytes) -> None:
    """Both ways through `read_mesh` end in the same mesh, or in the same refusal."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(meshes, "read_plain_obj", lambda _: None)
        slow = outcome(data)
    quick = outcome(data)
    assert quick[0] == slow[0], data
    for one, other in zip(quick[1:], slow[1:], strict=True):
        np.testing.assert_array_equal(one, other, str(data[:300]))


def outcome(data: bytes) -> tuple[object, ...]:
    try:
        mesh = read_mesh(data, "it.obj")
    except GeometryError as error:
        return (str(error),)
    return ("read", mesh.vertices, mesh.faces, mesh.vertex_colors)


@pytest.mark.heavy
@pytest.mark.shared
def test_real_files_are_read_alike(shared_dir: Path) -> None:
    for path in sorted((shared_dir / "meshes").glob("*.obj")):
        data = path.read_bytes()
        assert read_plain_obj(data) is not None, path.name
        assert_read_alike(data)


NUMBERS = st.sampled_from(
    [
        "0",
        "1",
        "-1",
        "0.5",
        "+2",
        ".25",
        "3.",
        "-0",
        "1e-1",
        "2e0",
        "255",
        "0.001961",
        "1e999",
        "-1e999",
        "1e308",
        "1e",
        "--1",
        "1-1",
        "",
        "0.1000000000000000055511151231257827021181583404541015625",
    ]
)
PLAIN_NUMBERS = st.floats(-2.0, 2.0, width=32).map(lambda number: f"{number:.6f}")
INDICES = st.integers(1, 3).map(str)
ODD_INDICES = st.sampled_from(["0", "-1", "+1", "1.0", "1e0", "2.5", "01", "7", "99999999999999999999"])


@st.composite
def obj_files(draw: st.DrawFn) -> bytes:
    """Small files: most of them plain, some with one odd line, gap or end of line."""
    columns = draw(st.sampled_from([3, 3, 6, 6, 4]))
    numbers = draw(st.sampled_from([PLAIN_NUMBERS, PLAIN_NUMBERS | NUMBERS]))
    indices = draw(st.sampled_from([INDICES, INDICES | ODD_INDICES]))
    gap, end = draw(st.sampled_from([" ", " ", "  "])), draw(st.sampled_from(["\n", "\n", "\r\n", " \n", "\r"]))
    vertices = draw(st.lists(st.lists(numbers, min_size=columns, max_size=columns), min_size=3, max_size=5))
    faces = draw(st.lists(st.lists(indices, min_size=3, max_size=3), min_size=1, max_size=4))
    if draw(st.booleans()):  # every vertex a corner
        faces += [["1", "2", str(last)] for last in range(3, len(vertices) + 1)]
    lines = [gap.join(["v", *vertex]) for vertex in vertices] + [gap.join(["f", *face]) for face in faces]
    if draw(st.integers(0, 4)) == 0:
        odd = draw(
            st.sampled_from(["", "# note", "v", "f", "f 1 2", "f 1 2 3 4", "f 1/1 2/1 3/1", "v 0 0 0", "e 1", "v 1 v"])
        )
        lines.insert(draw(st.integers(0, len(lines))), odd)
    return (end.join(lines) + draw(st.sampled_from([end, ""]))).encode()


@pytest.mark.heavy
@pytest.mark.parametrize("few_bytes", [plain_obj._FEW_BYTES, 0], ids=["numpy", "arrow"])
@given(data=obj_files())
def test_any_small_file_is_read_alike_or_left_alone(few_bytes: int, data: bytes) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(plain_obj, "_FEW_BYTES", few_bytes)
        if read_plain_obj(data) is not None:
            assert_read_alike(data)


def test_a_comment_does_not_change_the_size_of_a_mesh_with_a_stray_vertex() -> None:
    stray = CORNERS + b"v 2 2 2\n" + FACES
    sizes = [np.ptp(read_mesh(data, "it.obj").vertices, axis=0) for data in (stray, b"# a comment\n" + stray)]
    np.testing.assert_array_equal(*sizes)


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
        CORNERS + FACES + b"f 1.0 2 3\n",
        CORNERS + FACES + b"f 1e0 2 3\n",
        CORNERS + b"f 1 2 3\n",
        CORNERS + b"v 2 2 2\n" + FACES,
        CORNERS + b"f 1 2 99999999999999999999\n",
        b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        b"v 0 0\nv 1 0 0 0\nv 0 1 0\nf 1 2 3\n",
        b"v 0 0 --1\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        b"v 0 0 0 0.5\nv 1 0 0 0.5\nv 0 1 0 0.5\nf 1 2 3\n",
        b"v 0 0 1e999\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        b"v 0 0 0 1 0 1e308\nv 1 0 0 0 1 0\nv 0 1 0 0 0 1\nf 1 2 3\n",
        b"v 0 0 0 1 0 1e999\nv 1 0 0 0 1 0\nv 0 1 0 0 0 1\nf 1 2 3\n",
    ],
)
def test_anything_else_is_left_alone(data: bytes) -> None:
    assert read_plain_obj(data) is None


THREE = b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(
    "data",
    [
        b"v 0 0 0 255 0 0\nv 1 0 0 0 255 0\nv 0 1 0 0 0 128\nf 1 2 3\n",
        b"v 0 0 0 1 0 -5\nv 1 0 0 0 1e30 0\nv 0 1 0 0 0 1\nf 1 2 3\n",
        THREE + b"v 0 1 0\nf 1 2 3\nf 1 2 4\nf 1 1 2\n",
        THREE + b"f +1 02 3",
        b"v  0 0  0\nv 1 0 0 \nv 0 1 0\nf 1  2 3 \n",
        b"v 0 0 0\rv 1 0 0\rv 0 1 0\rf 1 2 3\r",
        THREE.replace(b"\n", b"\r\r\n") + b"f 1 2 3\r\r\n",
        b"v 0.1000000000000000055511151231257827021181583404541015625 0 0\nv 1 0 0\nv 0 1e5 0\nf 1 2 3\n",
        THREE + b"f 1 2 3\nf 1 2 3 \n\n",
    ],
)
def test_odd_but_plain_files_are_read_alike(data: bytes) -> None:
    assert_read_alike(data)
