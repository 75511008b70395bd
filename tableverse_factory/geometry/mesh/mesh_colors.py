"""Merge the meshes of a file with their colours: textures, plain materials, or vertex colours."""

import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Float64
from PIL import Image

from schemas.geometry import Colors, Matrix4, Picture, Points, Texture, TriangleMesh
from schemas.identity import content_hash
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.core.storage.untrusted import IMAGE_FORMATS

MAX_SIDE = 2048  # larger pictures are reduced
MAX_SHEET = 4096  # side of the atlas that holds the pictures of several materials, but for rows of plain colours
MOST_PICTURES = 4  # pixels of all pictures of a mesh, as a multiple of the most that one may have
DEFAULT_COLOR = (178, 178, 184)  # sRGB of uncoloured parts beside coloured ones


@dataclass(frozen=True, slots=True, eq=False)
class MaterialPart:
    """A mesh of a file, and the matrix from its own frame to the file's; a copy would lose the formats of pictures."""

    mesh: trimesh.Trimesh
    matrix: Matrix4

    def vertices(self) -> Points:
        """Vertices in the file's frame."""
        own = np.asarray(self.mesh.vertices, dtype=np.float64)
        if np.array_equal(self.matrix, np.eye(4)):
            return own
        return own @ self.matrix[:3, :3].T + self.matrix[:3, 3]

    def faces(self) -> np.ndarray:
        """Faces, counter-clockwise seen from outside also where the node mirrors."""
        own = np.asarray(self.mesh.faces, dtype=np.int64)
        return own[:, ::-1] if np.linalg.det(self.matrix[:3, :3]) < 0.0 else own


@dataclass(frozen=True, slots=True, eq=False)
class _Paint:
    """A part's picture with uv coordinates of the vertices, or its plain colour (`uv` is None)."""

    picture: Picture
    uv: Float64[np.ndarray, "n 2"] | None


def merge_parts(parts: Sequence[MaterialPart], max_pixels: int) -> TriangleMesh:
    """Merge parts into one mesh, with one texture if any part has a picture, else with vertex colours if any has one.

    With a texture, vertices at the same place become one: files split them at its seams.
    """
    if not parts:
        raise GeometryError("it holds no triangles")
    meshes = [part.mesh for part in parts]
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    vertices = np.concatenate([part.vertices() for part in parts])
    faces = np.concatenate([part.faces() + start for part, start in zip(parts, starts, strict=True)])
    paints = _read_paints(meshes, max_pixels)
    if any(paint is not None and paint.uv is not None for paint in paints):
        vertices, index = _weld_vertices(vertices)
        return TriangleMesh(vertices, index[faces].astype(np.int32), None, _merge_textures(parts, paints))
    return TriangleMesh(vertices, faces.astype(np.int32), _merge_vertex_colors(meshes, paints))


def _read_paints(meshes: Sequence[trimesh.Trimesh], max_pixels: int) -> list[_Paint | None]:
    """Read the materials; their pictures are reduced to fit into the atlas together."""
    images = {id(mesh): image for mesh in meshes if (image := _get_picture(mesh)) is not None}
    digests = {key: _hash_picture(image) for key, image in images.items()}
    distinct = dict(zip(digests.values(), images.values(), strict=True))
    pixels = [math.prod(image.size) for image in distinct.values()]
    for some, count, most in (("a texture", max(pixels, default=0), 1), ("all textures", sum(pixels), MOST_PICTURES)):
        if count > most * max_pixels:
            raise GeometryError(f"{some} of {count} pixels; at most {most * max_pixels} are decoded")
    sizes = {}  # of a picture once for each tint
    for mesh in meshes:
        if (image := images.get(id(mesh))) is not None:
            sizes[f"{digests[id(mesh)]} {getattr(mesh.visual.material, 'baseColorFactor', None)}"] = image.size[::-1]
    side = _choose_side(sizes)
    pictures = {digest: _shrink(image.convert("RGB"), side) for digest, image in distinct.items()}
    return [_read_paint(mesh, pictures.get(digests.get(id(mesh), ""))) for mesh in meshes]


def _choose_side(sizes: Mapping[str, tuple[int, int]]) -> int:
    """Choose the longest side to which pictures of these heights and widths are reduced, so that all fit."""
    side = MAX_SIDE
    while side > 1:
        shares = {key: min(1.0, side / max(size)) for key, size in sizes.items()}
        reduced = {k: (math.ceil(h * shares[k]), math.ceil(w * shares[k])) for k, (h, w) in sizes.items()}
        if not reduced or _arrange_pictures(reduced)[1].max() <= MAX_SHEET:
            break
        side = side * 15 // 16
    return side


def _hash_picture(image: Image.Image) -> str:
    """Hash a picture by its file, or by its pixels once it is decoded; materials may open one file several times."""
    stream = getattr(image, "fp", None)
    return content_hash(stream.getvalue() if isinstance(stream, io.BytesIO) else image.tobytes())


def _get_picture(mesh: trimesh.Trimesh) -> Image.Image | None:
    """Get the picture of a mesh with uv coordinates; trimesh supplies one of its own, without a format, elsewhere."""
    material, uv = getattr(mesh.visual, "material", None), getattr(mesh.visual, "uv", None)
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    has_uv = uv is not None and len(uv) == len(mesh.vertices)
    is_picture = isinstance(image, Image.Image) and image.format in IMAGE_FORMATS and 0 not in image.size
    return image if is_picture and has_uv else None


def _read_paint(mesh: trimesh.Trimesh, picture: Picture | None) -> _Paint | None:
    """Read a material, if there is one; an OBJ's plain colour does not tint its picture."""
    if mesh.visual.kind != "texture":
        return None
    material = mesh.visual.material
    linear, plain = getattr(material, "baseColorFactor", None), getattr(material, "kwargs", {}).get("kd")
    if picture is not None:
        return _Paint(_apply_tint(picture, linear), np.nan_to_num(np.asarray(mesh.visual.uv, dtype=np.float64)))
    if linear is not None:
        return _Paint(_apply_tint(np.full((1, 1, 3), 255, dtype=np.uint8), linear), None)
    if plain is not None and len(plain) >= 3:
        return _Paint(_round_to_bytes(255.0 * np.asarray(plain[:3], dtype=np.float64)).reshape(1, 1, 3), None)
    return None


def _apply_tint(picture: Picture, factor: np.ndarray | None) -> Picture:
    """Multiply a picture by glTF's colour factor, which is given in linear light."""
    if factor is None or (np.asarray(factor)[:3] == 255).all():
        return picture
    srgb = np.arange(256)[:, None] / 255.0
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    linear = linear * (np.asarray(factor, dtype=np.float64)[:3] / 255.0)
    table = _round_to_bytes(255.0 * np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055))
    return np.stack([table[picture[..., k], k] for k in range(3)], axis=-1)


def _round_to_bytes(values: np.ndarray) -> np.ndarray:
    return np.rint(np.clip(np.nan_to_num(values), 0.0, 255.0)).astype(np.uint8)


def _merge_vertex_colors(meshes: Sequence[trimesh.Trimesh], paints: Sequence[_Paint | None]) -> Colors | None:
    if not any(p is not None or mesh.visual.kind == "vertex" for mesh, p in zip(meshes, paints, strict=True)):
        return None
    colors = np.concatenate([_make_vertex_colors(mesh, paint) for mesh, paint in zip(meshes, paints, strict=True)])
    return np.ascontiguousarray(colors, dtype=np.uint8)


def _make_vertex_colors(mesh: trimesh.Trimesh, paint: _Paint | None) -> Colors:
    if mesh.visual.kind == "vertex":
        return np.asarray(mesh.visual.vertex_colors[:, :3], dtype=np.uint8)
    color = np.array(DEFAULT_COLOR, dtype=np.uint8) if paint is None else paint.picture[0, 0]
    return np.tile(color, (len(mesh.vertices), 1))


def _merge_textures(parts: Sequence[MaterialPart], paints: Sequence[_Paint | None]) -> Texture:
    """Arrange all pictures in an atlas and map each part's uv coordinates to its own.

    Coordinates that wrap around are brought back face by face; a face over several repetitions shows one.
    """
    pictures = [
        _round_to_bytes(_make_vertex_colors(part.mesh, None).mean(axis=0)).reshape(1, 1, 3)
        if paint is None
        else paint.picture
        for part, paint in zip(parts, paints, strict=True)
    ]
    keys = [content_hash(repr(picture.shape).encode(), picture.tobytes()) for picture in pictures]
    unique = dict(zip(keys, pictures, strict=True))
    places, sheet_size = _arrange_pictures({key: picture.shape[:2] for key, picture in unique.items()})
    sheet = np.zeros((sheet_size[1], sheet_size[0], 3), dtype=np.uint8)
    corners = []
    for part, paint, picture, key in zip(parts, paints, pictures, keys, strict=True):
        (height, width), (left, top) = picture.shape[:2], places[key]
        sheet[top : top + height, left : left + width] = picture
        uv = _wrap_corner_uv(part, paint)
        if len(unique) > 1:  # to the centres of the outer pixels, so that no neighbour bleeds in
            across, down = left + uv[..., 0] * (width - 1), top + (1.0 - uv[..., 1]) * (height - 1)
            pixel = 0.5 + np.stack([across, down], axis=-1)
            uv = np.array([0.0, 1.0]) + pixel / sheet_size * np.array([1.0, -1.0])
        corners.append(uv)
    return Texture(sheet, np.concatenate(corners))


def _arrange_pictures(sizes: Mapping[str, tuple[int, int]]) -> tuple[dict[str, tuple[int, int]], np.ndarray]:
    """Arrange pictures of these heights and widths in rows, the highest first, no wider than the sheet.

    Returns the left upper pixel of each, and width and height.
    """
    widest, area = max(width for _, width in sizes.values()), sum(height * width for height, width in sizes.values())
    square = max(widest, math.ceil(math.sqrt(area)))
    across = min(-(-square // widest) * widest, max(widest, MAX_SHEET))
    places, left, top, right, bottom = {}, 0, 0, 0, 0
    for key, (height, width) in sorted(sizes.items(), key=lambda each: (-each[1][0], -each[1][1])):
        if left + width > across:
            left, top = 0, bottom
        places[key] = left, top
        left += width
        right, bottom = max(right, left), max(bottom, top + height)
    return places, np.array([right, bottom])


def _wrap_corner_uv(part: MaterialPart, paint: _Paint | None) -> Float64[np.ndarray, "m 3 2"]:
    if paint is None or paint.uv is None:
        return np.full((len(part.mesh.faces), 3, 2), 0.5)
    corners = np.clip(paint.uv, -1e6, 1e6)[part.faces()]
    outside = ((corners < 0.0) | (corners > 1.0)).any(axis=(1, 2))
    corners[outside] -= np.floor(corners[outside].min(axis=1, keepdims=True))
    return np.clip(corners, 0.0, 1.0)


def _shrink(image: Image.Image, most: int) -> Picture:
    """Reduce a picture in place to at most `most` pixels a side."""
    image.thumbnail((most, most))
    return np.array(image)


def _weld_vertices(vertices: Points) -> tuple[Points, np.ndarray]:
    """Distinct vertices, in order of first appearance, and the index of each vertex among them."""
    _, first, index = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    place = np.empty(len(first), dtype=np.int64)
    place[np.argsort(first, kind="stable")] = np.arange(len(first))
    return vertices[np.sort(first)], place[index.reshape(-1)]
