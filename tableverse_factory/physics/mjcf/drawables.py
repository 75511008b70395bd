"""What there is to draw of a scene: its meshes and its table as they stand, from records or from a MuJoCo model."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from schemas.geometry import Frozen, Texture, TriangleMesh
from tableverse_factory.physics.mjcf.slab import THICKNESS_M, Slab

Rgb = tuple[int, int, int]


@dataclass(frozen=True, slots=True, eq=False)
class Scenery(Frozen):
    """Meshes in the table frame; the last part is the table.

    Attributes:
        names: Object id of each part but the last.
        parts: Meshes as they stand [m], in their own colours where they have some.
        colors: sRGB of each part that has no texture of its own.
    """

    names: tuple[str, ...]
    parts: tuple[TriangleMesh, ...]
    colors: tuple[Rgb | None, ...]


def scenery_of(names: Sequence[str], meshes: Sequence[TriangleMesh], slab: Slab) -> Scenery:
    """Of meshes that stand in the table frame, on their slab."""
    table = box_mesh(np.array([*slab.half_size_xy, THICKNESS_M / 2]))
    c, s = np.cos(slab.yaw), np.sin(slab.yaw)
    turned = table.vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    board = TriangleMesh(turned + np.array([*slab.center_xy, -THICKNESS_M / 2]), table.faces)
    return Scenery(tuple(names), (*meshes, board), (*(None for _ in meshes), slab.color))


def scenery_of_model(model: mujoco.MjModel, table: str = "table", visual_group: int = 2) -> Scenery:
    """Of a model in its initial state, as the simulator has it: the visual meshes, and the box that is the table.

    Args:
        model: Compiled.
        table: Name of the table's body.
        visual_group: Group of the geoms that are drawn.
    """
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    names: list[str] = []
    parts: list[TriangleMesh] = []
    colors: list[Rgb | None] = []
    boards: list[tuple[TriangleMesh, Rgb | None]] = []
    for geom in range(model.ngeom):
        body = model.body(int(model.geom_bodyid[geom])).name
        kind = int(model.geom_type[geom])
        if kind == mujoco.mjtGeom.mjGEOM_BOX and body == table:
            board = _placed(geom_box(model, geom), data, geom)
            boards.append((board, None if board.texture is not None else geom_color(model, geom)))
        elif kind == mujoco.mjtGeom.mjGEOM_MESH and int(model.geom_group[geom]) == visual_group:
            mesh = geom_mesh(model, geom)
            names.append(body)
            parts.append(_placed(mesh, data, geom))
            colors.append(None if mesh.texture is not None else geom_color(model, geom))
    for board, color in boards[:1]:
        parts.append(board)
        colors.append(color)
    return Scenery(tuple(names), tuple(parts), tuple(colors))


def box_mesh(half_size: np.ndarray) -> TriangleMesh:
    """An axis-aligned box around the origin [m]; its faces share no vertices, so that edges stay sharp."""
    vertices: list[np.ndarray] = []
    faces: list[np.ndarray] = []
    for axis in range(3):
        u, v = (axis + 1) % 3, (axis + 2) % 3
        for sign in (-1.0, 1.0):
            corners = np.zeros((4, 3))
            corners[:, axis] = sign
            corners[:, u], corners[:, v] = (-1, 1, 1, -1), (-1, -1, 1, 1)
            first = 4 * len(vertices)
            vertices.append(corners * half_size)
            quad = [[0, 1, 2], [0, 2, 3]] if sign > 0 else [[0, 2, 1], [0, 3, 2]]
            faces.append(np.array(quad, dtype=np.int32) + first)
    return TriangleMesh(np.concatenate(vertices), np.concatenate(faces))


def _placed(mesh: TriangleMesh, data: mujoco.MjData, geom: int) -> TriangleMesh:
    rotation = data.geom_xmat[geom].reshape(3, 3)
    return replace(mesh, vertices=mesh.vertices @ rotation.T + data.geom_xpos[geom])


def geom_box(model: mujoco.MjModel, geom: int) -> TriangleMesh:
    """The geom's box in its own frame; its texture repeats as MuJoCo has it, from the left edge and the far one."""
    half = np.array(model.geom_size[geom])
    box, picture = box_mesh(half), _texture(model, geom)
    if picture is None:
        return box
    material = int(model.geom_matid[geom])
    repeat = np.array(model.mat_texrepeat[material]) * (half[:2] if model.mat_texuniform[material] else 1.0)
    share = (1.0 + box.vertices[:, :2] / half[:2] * [1.0, -1.0]) / 2
    uv = share * repeat * [1.0, -1.0] + [0.0, 1.0]
    return replace(box, texture=Texture(picture, uv[box.faces]))


def geom_mesh(model: mujoco.MjModel, geom: int) -> TriangleMesh:
    """The geom's mesh in its own frame, with its texture where it has one."""
    mesh = int(model.geom_dataid[geom])
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    start, faces_count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
    vertices = model.mesh_vert[first : first + count].astype(np.float64)
    faces = model.mesh_face[start : start + faces_count].astype(np.int32)
    picture = _texture(model, geom)
    uv_first, uv_count = int(model.mesh_texcoordadr[mesh]), int(model.mesh_texcoordnum[mesh])
    if picture is None or uv_first < 0:
        return TriangleMesh(vertices, faces)
    uv = model.mesh_texcoord[uv_first : uv_first + uv_count].astype(np.float64)
    corners = model.mesh_facetexcoord[start : start + faces_count]
    # MuJoCo turns v over when it reads an OBJ: row 0 of the picture is v = 0 there.
    return TriangleMesh(vertices, faces, texture=Texture(picture, uv[corners] * [1.0, -1.0] + [0.0, 1.0]))


def _texture(model: mujoco.MjModel, geom: int) -> np.ndarray | None:
    """Pixels in sRGB of the geom's colour map. Shape (h, w, 3)."""
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


def geom_color(model: mujoco.MjModel, geom: int) -> Rgb:
    """The one colour that the geom or its material has, sRGB."""
    material = int(model.geom_matid[geom])
    rgba = model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]
    red, green, blue = (int(np.clip(np.rint(255 * value), 0, 255)) for value in rgba[:3])
    return red, green, blue
