"""Baking of a mesh's colours to a texture: MuJoCo, like most simulators, ignores vertex colours.

Meshes get an atlas of triangles, filled from the picture where it shows them and from the vertices' colours elsewhere.
Denser meshes get one colour per face, all corners of a face at the same texel: then no filter mixes colours, and equal
colours share a texel.
"""

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Float64

from schemas.geometry import Points, Texture, TriangleMesh
from tableverse_factory.core.memoize import memoize_by_content
from tableverse_factory.core.png import encode_png
from tableverse_factory.physics.mjcf.obj_assets import Appearance
from tableverse_factory.stages.export.atlas import Atlas, find_corner_texels, lay_out_atlas, list_triangle_texels
from tableverse_factory.stages.export.projected_color import ColorProjector, PhotographedMesh

SMALL_SIDE, LARGE_SIDE = 256, 512
COARSER = 0.8  # factor of the density after each try that does not fit
SMALL_TRIES, LARGE_TRIES = 4, 24  # small: down to half the picture's density; large: until the atlas fits

REMEMBERED_BYTES = 64 * 1024 * 1024  # textures of a hundred things

# Maps faces and barycentric weights of points on them to sRGB.
Painter = Callable[[np.ndarray, Float64[np.ndarray, "n 3"]], Float64[np.ndarray, "n 3"]]


def bake_texture(mesh: TriangleMesh, photograph: ColorProjector | None = None) -> Appearance | None:
    """Bake the mesh's own texture, else one from its vertex colours and the picture; None without colours."""
    if mesh.texture is not None:
        return _encode_texture(mesh.texture)
    if mesh.vertex_colors is None:
        return None
    photographed = None if photograph is None else PhotographedMesh(photograph, mesh)
    detail = _measure_detail(mesh, photographed)
    painter = partial(_paint, mesh, photographed, detail > 0.0)
    atlas = _choose_atlas(mesh, detail)
    return _bake_faces(len(mesh.faces), painter) if atlas is None else _bake_atlas(atlas, painter)


@memoize_by_content(REMEMBERED_BYTES)
def _encode_texture(texture: Texture) -> Appearance:
    """Cached: layouts and cousins show the same things in scene after scene."""
    return Appearance.at_corners(encode_png(np.asarray(texture.picture)), texture.corner_uv)


def _measure_detail(mesh: TriangleMesh, photographed: PhotographedMesh | None) -> Float64[np.ndarray, " m"]:
    """Measure the texels per metre of each face: the picture's own where it shows the face, 0 elsewhere."""
    detail = np.zeros(len(mesh.faces))
    if photographed is not None:
        probes = np.concatenate([mesh.vertices[mesh.faces], mesh.vertices[mesh.faces].mean(axis=1, keepdims=True)], 1)
        face_of = np.repeat(np.arange(len(detail)), probes.shape[1])
        shown, _ = photographed.find_shown(probes.reshape(-1, 3), face_of)
        detail[face_of[shown]] = photographed.texels_per_metre
    return detail


def _choose_atlas(mesh: TriangleMesh, detail: Float64[np.ndarray, " m"]) -> Atlas | None:
    sizes = ((SMALL_SIDE, SMALL_TRIES), (LARGE_SIDE, LARGE_TRIES)) if detail.any() else ((SMALL_SIDE, 1),)
    for side, tries in sizes:
        for power in range(tries):
            if atlas := lay_out_atlas(mesh, detail * COARSER**power, side):
                return atlas
    return None


def _paint(
    mesh: TriangleMesh,
    photographed: PhotographedMesh | None,
    shown: np.ndarray,
    faces: np.ndarray,
    weights: Float64[np.ndarray, "n 3"],
) -> Float64[np.ndarray, "n 3"]:
    colors = np.empty((len(faces), 3))
    plain = np.ones(len(faces), dtype=bool)
    if photographed is not None:
        worth = np.flatnonzero(shown[faces])
        points: Points = np.einsum("nk,nkd->nd", weights[worth], mesh.vertices[mesh.faces[faces[worth]]])
        seen, pixels = photographed.find_shown(points, faces[worth])
        colors[worth[seen]] = photographed.sample_colors(pixels)
        plain[worth[seen]] = False
    assert mesh.vertex_colors is not None  # noqa: S101 - bake asks first
    own = mesh.vertex_colors[mesh.faces[faces[plain]]].astype(np.float64)
    colors[plain] = np.einsum("nk,nkd->nd", weights[plain], own)
    return colors


def _bake_faces(count: int, painter: Painter) -> Appearance:
    mixed = np.rint(painter(np.arange(count), np.full((count, 3), 1 / 3))).astype(np.uint8)
    colors, texel = _reduce_colors(mixed, SMALL_SIDE * SMALL_SIDE)
    side = int(np.ceil(np.sqrt(len(colors))))
    picture = np.empty((side * side, 3), dtype=np.uint8)
    picture[: len(colors)], picture[len(colors) :] = colors, colors[-1]
    row, column = np.divmod(np.arange(len(colors)), side)
    points = _compute_texel_uv(column, row, side)
    return Appearance(encode_png(picture.reshape(side, side, 3)), points, np.repeat(texel[:, None], 3, axis=1))


def _bake_atlas(atlas: Atlas, painter: Painter) -> Appearance:
    faces, texels, weights = [], [], []
    for square in np.unique(atlas.square).tolist():
        for second in (False, True):
            these = np.flatnonzero((atlas.square == square) & (atlas.second == second))
            inside, shares = list_triangle_texels(square, second)
            faces.append(np.repeat(these, len(inside)))
            texels.append((atlas.corner[these][:, None] + inside[None]).reshape(-1, 2))
            weights.append(np.tile(shares, (len(these), 1)))
    column, row = np.concatenate(texels).T
    colors = np.rint(painter(np.concatenate(faces), np.concatenate(weights))).astype(np.uint8)
    picture = np.empty((atlas.side, atlas.side, 3), dtype=np.uint8)
    picture[:] = np.rint(colors.mean(axis=0))
    picture[row, column] = colors
    corners = find_corner_texels(atlas)
    return Appearance.at_corners(encode_png(picture), _compute_texel_uv(corners[..., 0], corners[..., 1], atlas.side))


def _compute_texel_uv(column: np.ndarray, row: np.ndarray, side: int) -> np.ndarray:
    """Compute texture coordinates; v of an OBJ points up, the rows of a picture go down."""
    return np.stack([(column + 0.5) / side, 1.0 - (row + 0.5) / side], axis=-1)


def _reduce_colors(colors: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Reduce to sorted distinct colours, with the index of each; coarser bit by bit until there are at most `most`."""
    places = np.array([16, 8, 0])
    for shift in range(8):
        coarse = (colors >> shift << shift) + ((1 << shift) >> 1)
        found, index = np.unique((coarse.astype(np.int64) << places).sum(axis=1), return_inverse=True)
        if len(found) <= most:
            break
    return (found[:, None] >> places & 255).astype(np.uint8), index
