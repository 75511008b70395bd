"""Visual geometry of a scene: its meshes and its table in place, from records or from a MuJoCo model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product

import mujoco
import numpy as np

from schemas.geometry import Frozen, Texture, TriangleMesh
from tableverse_factory.physics.mjcf.slab import THICKNESS_M, Slab

Rgb = tuple[int, int, int]
UNBOUNDED_PLANE_M = 1.0  # half the side drawn for an infinite plane [m]


@dataclass(frozen=True, slots=True, eq=False)
class Scenery(Frozen):
    """Meshes as they stand in the table frame [m]; the last part is the table, which has no name.

    `colors` holds the sRGB of each part that has no texture of its own.
    """

    names: tuple[str, ...]
    parts: tuple[TriangleMesh, ...]
    colors: tuple[Rgb | None, ...]


def make_scenery(names: Sequence[str], meshes: Sequence[TriangleMesh], slab: Slab) -> Scenery:
    """Make the scenery of meshes in the table frame, on their slab."""
    table = make_box_mesh(np.array([*slab.half_size_xy, THICKNESS_M / 2]))
    c, s = np.cos(slab.yaw), np.sin(slab.yaw)
    turned = table.vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    board = TriangleMesh(turned + np.array([*slab.center_xy, -THICKNESS_M / 2]), table.faces)
    return Scenery(tuple(names), (*meshes, board), (*(None for _ in meshes), slab.color))


def load_scenery(model: mujoco.MjModel, visual_group: int = 2) -> Scenery:
    """Load the visual meshes and the table's box of a model in its initial state."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    names: list[str] = []
    placed: list[tuple[TriangleMesh, Rgb | None]] = []
    boards: list[tuple[TriangleMesh, Rgb | None]] = []
    for geom in range(model.ngeom):
        body = model.body(int(model.geom_bodyid[geom])).name
        kind = int(model.geom_type[geom])
        if kind == mujoco.mjtGeom.mjGEOM_BOX and body == "table":
            boards.append(_place_geom(make_geom_box(model, geom), model, data, geom))
        elif kind == mujoco.mjtGeom.mjGEOM_MESH and int(model.geom_group[geom]) == visual_group:
            names.append(body)
            placed.append(_place_geom(read_geom_mesh(model, geom), model, data, geom))
    placed += boards[:1]
    return Scenery(tuple(names), tuple(mesh for mesh, _ in placed), tuple(color for _, color in placed))


def make_box_mesh(half_size: np.ndarray) -> TriangleMesh:
    """Make an axis-aligned box around the origin [m]; its faces share no vertices, so that edges stay sharp."""
    vertices, faces = np.zeros((6, 4, 3)), np.zeros((6, 2, 3), dtype=np.int32)
    for side, (axis, sign) in enumerate(product(range(3), (-1.0, 1.0))):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        vertices[side, :, axis], vertices[side, :, u], vertices[side, :, v] = sign, (-1, 1, 1, -1), (-1, -1, 1, 1)
        faces[side] = 4 * side + np.array([[0, 1, 2], [0, 2, 3]] if sign > 0 else [[0, 2, 1], [0, 3, 2]])
    return TriangleMesh(vertices.reshape(-1, 3) * half_size, faces.reshape(-1, 3))


def _place_geom(
    mesh: TriangleMesh, model: mujoco.MjModel, data: mujoco.MjData, geom: int
) -> tuple[TriangleMesh, Rgb | None]:
    """Place a geom's mesh, and read its colour where it has no texture."""
    rotation = data.geom_xmat[geom].reshape(3, 3)
    placed = replace(mesh, vertices=mesh.vertices @ rotation.T + data.geom_xpos[geom])
    return placed, None if mesh.texture is not None else read_geom_color(model, geom)


def make_geom_box(model: mujoco.MjModel, geom: int) -> TriangleMesh:
    """Make the geom's box in its own frame, with its texture."""
    half = np.array(model.geom_size[geom])
    return _cover(make_box_mesh(half), half[:2], model, geom)


def make_geom_plane(model: mujoco.MjModel, geom: int) -> TriangleMesh:
    """Make the geom's plane in its own frame, with its texture; an infinite one is drawn as a rectangle."""
    half = np.array([side if side > 0.0 else UNBOUNDED_PLANE_M for side in model.geom_size[geom, :2]])
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [*half, 0.0]
    sheet = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))
    return _cover(sheet, half, model, geom)


def _cover(mesh: TriangleMesh, half: np.ndarray, model: mujoco.MjModel, geom: int) -> TriangleMesh:
    """Give a mesh the geom's texture, which repeats as in MuJoCo, from the left edge and the far one."""
    picture, material = _read_texture(model, geom), int(model.geom_matid[geom])
    if picture is None:
        return mesh
    repeat = np.array(model.mat_texrepeat[material]) * (half if model.mat_texuniform[material] else 1.0)
    share = (1.0 + mesh.vertices[:, :2] / half * [1.0, -1.0]) / 2
    uv = share * repeat * [1.0, -1.0] + [0.0, 1.0]
    return replace(mesh, texture=Texture(picture, uv[mesh.faces]))


def read_geom_mesh(model: mujoco.MjModel, geom: int) -> TriangleMesh:
    """Read the geom's mesh in its own frame, with its texture where it has one."""
    index = int(model.geom_dataid[geom])
    mesh, picture = read_mesh(model, index), _read_texture(model, geom)
    first, count = int(model.mesh_texcoordadr[index]), int(model.mesh_texcoordnum[index])
    if picture is None or first < 0:
        return mesh
    uv = model.mesh_texcoord[first : first + count].astype(np.float64)
    start = int(model.mesh_faceadr[index])
    corners = model.mesh_facetexcoord[start : start + len(mesh.faces)]
    # MuJoCo flips v when it reads an OBJ: row 0 of the picture is v = 0 there.
    return replace(mesh, texture=Texture(picture, uv[corners] * [1.0, -1.0] + [0.0, 1.0]))


def read_mesh(model: mujoco.MjModel, index: int) -> TriangleMesh:
    """Read a mesh of a model by its index, without colours."""
    vertex, face = int(model.mesh_vertadr[index]), int(model.mesh_faceadr[index])
    vertices = model.mesh_vert[vertex : vertex + int(model.mesh_vertnum[index])].astype(np.float64)
    return TriangleMesh(vertices, model.mesh_face[face : face + int(model.mesh_facenum[index])].astype(np.int32))


def _read_texture(model: mujoco.MjModel, geom: int) -> np.ndarray | None:
    """Read the geom's colour map. Shape (h, w, 3) sRGB."""
    material = int(model.geom_matid[geom])
    if material < 0:
        return None
    texture = int(model.mat_texid[material][mujoco.mjtTextureRole.mjTEXROLE_RGB])
    if texture < 0:
        return None
    height, width = int(model.tex_height[texture]), int(model.tex_width[texture])
    channels, first = int(model.tex_nchannel[texture]), int(model.tex_adr[texture])
    pixels = model.tex_data[first : first + height * width * channels].reshape(height, width, channels)
    return np.repeat(pixels, 3, axis=2) if channels == 1 else np.array(pixels[..., :3])


def read_geom_color(model: mujoco.MjModel, geom: int) -> Rgb:
    """Read the uniform colour of the geom or its material, sRGB."""
    material = int(model.geom_matid[geom])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    red, green, blue = (int(np.clip(np.rint(255 * value), 0, 255)) for value in rgba[:3])
    return red, green, blue
