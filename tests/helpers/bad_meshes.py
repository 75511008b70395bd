"""Meshes that nobody should make and everybody has, by name: what they are, and what may become of them."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.meshes import from_trimesh

BOX = from_trimesh(trimesh.creation.box((0.1, 0.08, 0.06)))
BALL = from_trimesh(trimesh.creation.icosphere(3, 0.04))


@dataclass(frozen=True)
class BadMesh:
    """A way to be bad.

    Attributes:
        make: The mesh.
        ends: What it may end as: notes of `closed_solid` for ways in which the object may survive, `refused`
            where the mesh may be refused with a reason.
    """

    make: Callable[[], TriangleMesh]
    ends: frozenset[str]


def _mesh(vertices: object, faces: object) -> TriangleMesh:
    return TriangleMesh(np.array(vertices, dtype=np.float64), np.array(faces, dtype=np.int32).reshape(-1, 3))


def joined(*meshes: TriangleMesh) -> TriangleMesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    faces = [mesh.faces + int(start) for mesh, start in zip(meshes, starts, strict=True)]
    return _mesh(np.concatenate([m.vertices for m in meshes]), np.concatenate(faces))


def shifted(mesh: TriangleMesh, *by: float) -> TriangleMesh:
    return _mesh(mesh.vertices + np.array(by), mesh.faces)


def scaled(mesh: TriangleMesh, by: float) -> TriangleMesh:
    return _mesh(mesh.vertices * by, mesh.faces)


def open_box() -> TriangleMesh:
    return _mesh(BOX.vertices, BOX.faces[2:])


def torn() -> TriangleMesh:
    rng = np.random.default_rng(2)
    soup = BALL.vertices[BALL.faces].reshape(-1, 3)
    return _mesh(soup + rng.normal(scale=2e-4, size=soup.shape), np.arange(len(soup)))


def crossing() -> TriangleMesh:
    """One closed surface through itself: a bent tube that passes its own wall (as a Klein bottle's neck does)."""
    around, along = 48, 24
    t = np.linspace(0, 2 * np.pi, around, endpoint=False)
    s = np.linspace(0, 2 * np.pi, along, endpoint=False)
    path = np.stack([0.05 * np.sin(t), 0.05 * np.sin(2 * t), 0.004 * np.cos(t)], axis=1)  # an eight, hardly in depth
    tangent = np.roll(path, -1, axis=0) - np.roll(path, 1, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    ring = 0.015 * (np.cos(s)[None, :, None] * side[:, None] + np.sin(s)[None, :, None] * up[:, None])
    index = np.arange(around * along).reshape(around, along)
    right, above = np.roll(index, -1, axis=0), np.roll(index, -1, axis=1)
    both = np.roll(right, -1, axis=1)
    quads = np.stack([index, right, both, above], axis=-1).reshape(-1, 4)
    return _mesh((path[:, None] + ring).reshape(-1, 3), np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


def klein() -> TriangleMesh:
    """A Klein bottle: closed, and without an inside."""
    n = 48
    u, v = np.meshgrid(np.linspace(0, 2 * np.pi, n, endpoint=False), np.linspace(0, 2 * np.pi, n, endpoint=False))
    r = 2 + np.cos(u / 2) * np.sin(v) - np.sin(u / 2) * np.sin(2 * v)
    z = np.sin(u / 2) * np.sin(v) + np.cos(u / 2) * np.sin(2 * v)
    vertices = 0.02 * np.stack([r * np.cos(u), r * np.sin(u), z], axis=-1).reshape(-1, 3)
    index = np.arange(n * n).reshape(n, n)  # v down the rows, u along
    columns = np.concatenate([index, index[(-np.arange(n)) % n][:, :1]], axis=1)  # after a turn of u, v runs backwards
    down = np.roll(columns, -1, axis=0)
    quads = np.stack([columns[:, :-1], columns[:, 1:], down[:, 1:], down[:, :-1]], axis=-1).reshape(-1, 4)
    return _mesh(vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


def sheet(thickness: float) -> TriangleMesh:
    return from_trimesh(trimesh.creation.box((0.2, 0.15, thickness)))


def bowl(bottomless: bool) -> TriangleMesh:
    """A bowl of one sheet, open above; `bottomless`: a hole in its foot as well."""
    ball = trimesh.creation.icosphere(4, 0.07)
    middle = ball.triangles_center
    keep = middle[:, 2] < 0.0
    if bottomless:
        keep &= np.linalg.norm(middle[:, :2], axis=1) > 0.012
    ball.update_faces(keep)
    ball.remove_unreferenced_vertices()
    return shifted(from_trimesh(ball), 0, 0, 0.07)


def needles() -> TriangleMesh:
    """A drum whose caps are fans of needles, 6,000 to a turn."""
    return from_trimesh(trimesh.creation.cylinder(0.04, 0.06, sections=6000))


def fins() -> TriangleMesh:
    """Two boxes that share one edge, which then has four faces; and a fin on it."""
    other = shifted(BOX, 0.1, 0.0, 0.06)
    both = trimesh.Trimesh(*_arrays(joined(BOX, other)), process=False)
    both.merge_vertices()
    vertices = np.concatenate([both.vertices, [[0.05, 0.0, 0.1]]])
    return _mesh(vertices, np.concatenate([both.faces, [[0, 1, len(both.vertices)]]]))


def _arrays(mesh: TriangleMesh) -> tuple[np.ndarray, np.ndarray]:
    return mesh.vertices, mesh.faces


def shells(count: int) -> TriangleMesh:
    rng = np.random.default_rng(3)
    ball = from_trimesh(trimesh.creation.icosphere(1, 0.006))
    return joined(*(shifted(ball, *rng.uniform(-0.05, 0.05, 3)) for _ in range(count)))


def million_faces(noisy: bool) -> TriangleMesh:
    """A wavy slab of two million faces; `noisy` like a raw scan, and without its underside."""
    n = 708 if not noisy else 1001
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, n), np.linspace(-0.1, 0.1, n))
    z = 0.03 + 0.004 * np.sin(80 * x) * np.sin(60 * y)
    if noisy:
        z += np.random.default_rng(4).normal(scale=2e-4, size=z.shape)
    index = np.arange(n * n).reshape(n, n)
    a, b, c, d = index[:-1, :-1].ravel(), index[:-1, 1:].ravel(), index[1:, 1:].ravel(), index[1:, :-1].ravel()
    top = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3)
    if noisy:
        return _mesh(vertices, top)
    below = vertices * [1.0, 1.0, 0.0]
    ring = np.concatenate([index[0, :-1], index[:-1, -1], index[-1, :0:-1], index[:0:-1, 0]])
    after = np.roll(ring, -1)
    under = n * n
    wall = np.concatenate([np.stack([after, ring, ring + under], 1), np.stack([after, ring + under, after + under], 1)])
    return _mesh(np.concatenate([vertices, below]), np.concatenate([top, top[:, ::-1] + under, wall]))


def _ends(*names: str) -> frozenset[str]:
    return frozenset(names)


BAD_MESHES: dict[str, BadMesh] = {
    "open": BadMesh(open_box, _ends("filled")),
    "torn": BadMesh(torn, _ends("remeshed")),
    "self_intersecting": BadMesh(lambda: joined(BOX, shifted(BOX, 0.03, 0.02, 0.01)), _ends("")),
    "crossing_itself": BadMesh(crossing, _ends("", "remeshed")),
    "klein_bottle": BadMesh(klein, _ends("oriented", "filled", "remeshed")),
    "flat": BadMesh(lambda: scaled_z(BOX, 0.0), _ends("remeshed")),
    "single_triangle": BadMesh(lambda: _mesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], [[0, 1, 2]]), _ends("remeshed")),
    "no_area": BadMesh(lambda: _mesh([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], [[0, 1, 2]]), _ends("refused")),
    "no_faces": BadMesh(lambda: _mesh([[0, 0, 0], [0.1, 0, 0]], []), _ends("refused")),
    "nan": BadMesh(lambda: _mesh([[0, 0, 0], [0.1, 0, np.nan], [0, 0.1, 0]], [[0, 1, 2]]), _ends("refused")),
    "coordinates_1e30": BadMesh(lambda: scaled(BOX, 1e31), _ends("refused")),
    "index_out_of_range": BadMesh(lambda: _mesh(BOX.vertices, np.append(BOX.faces, [[0, 1, 99]], 0)), _ends("refused")),
    "three_micrometres": BadMesh(lambda: scaled(BOX, 3e-5), _ends("refused")),
    "forty_metres": BadMesh(lambda: scaled(BOX, 400.0), _ends("refused")),
    "inside_out": BadMesh(lambda: _mesh(BOX.vertices, BOX.faces[:, ::-1]), _ends("")),
    "two_shells": BadMesh(lambda: joined(BALL, scaled(BALL, 0.6)), _ends("")),
    "three_hundred_shells": BadMesh(lambda: shells(300), _ends("")),
    "duplicate_faces": BadMesh(lambda: _mesh(BOX.vertices, np.append(BOX.faces, BOX.faces[:5], 0)), _ends("merged")),
    "edges_of_four_faces": BadMesh(fins, _ends("oriented", "filled", "remeshed")),
    "sheet_of_0.1_mm": BadMesh(lambda: sheet(1e-4), _ends("")),
    "open_bowl": BadMesh(lambda: bowl(False), _ends("remeshed")),
    "bottomless_bowl": BadMesh(lambda: bowl(True), _ends("remeshed")),
    "needles": BadMesh(needles, _ends("")),
}

LARGE_MESHES: dict[str, BadMesh] = {
    "two_million_faces": BadMesh(lambda: million_faces(False), _ends("")),
    "two_million_faces_of_a_scan": BadMesh(lambda: million_faces(True), _ends("remeshed")),
}


def scaled_z(mesh: TriangleMesh, by: float) -> TriangleMesh:
    return _mesh(mesh.vertices * [1.0, 1.0, by], mesh.faces)
