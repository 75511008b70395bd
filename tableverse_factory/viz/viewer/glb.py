"""GLB meshes for the browser: visual meshes, and convex pieces in a colour each."""

import colorsys
from collections.abc import Sequence

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import ColorVisuals, TextureVisuals
from trimesh.visual.material import PBRMaterial

from schemas.geometry import TriangleMesh
from tableverse_factory.delivery.formats.model_contents import VisualMesh
from tableverse_factory.physics.mjcf.scenery import Rgb
from tableverse_factory.physics.render.normals import compute_corner_normals

ROUGHNESS = 0.8
_GOLDEN = 0.6180339887498949  # step between hues that keeps all of them far apart

PIECE_COLORS = 256  # number of colours; further pieces repeat them


def encode_visuals(looks: Sequence[VisualMesh]) -> bytes:
    """Encode the visual meshes of one object in its own frame, smooth with sharp creases."""
    scene = trimesh.Scene()
    for look in looks:
        if len(look.mesh.faces):
            scene.add_geometry(_split_corners(look.mesh, look.color))
    return _export_glb(scene, normals=True)


def encode_pieces(hulls: Sequence[TriangleMesh], first: int) -> bytes:
    """Encode the convex pieces of one object, each in its own colour and with flat faces."""
    scene = trimesh.Scene()
    if hulls:
        starts = np.cumsum([0, *(len(hull.vertices) for hull in hulls[:-1])])
        faces = np.concatenate([hull.faces + start for hull, start in zip(hulls, starts, strict=True)])
        colors = np.concatenate(
            [np.tile(choose_piece_color(first + k), (len(hull.vertices), 1)) for k, hull in enumerate(hulls)]
        )
        visual = ColorVisuals(vertex_colors=_convert_to_linear(colors))
        vertices = np.concatenate([hull.vertices for hull in hulls])
        scene.add_geometry(trimesh.Trimesh(vertices, faces, visual=visual, process=False))
    return _export_glb(scene, normals=False)


def choose_piece_color(number: int) -> Rgb:
    """Choose the colour of a piece; neighbouring numbers differ most."""
    turn = (0.58 + _GOLDEN * (number % PIECE_COLORS)) % 1.0
    red, green, blue = colorsys.hls_to_rgb(turn, (0.55, 0.42, 0.66)[number % 3], 0.62)
    return round(255 * red), round(255 * green), round(255 * blue)


def _split_corners(mesh: TriangleMesh, color: Rgb) -> trimesh.Trimesh:
    """Split a mesh into faces that share no vertex, so that each corner has its own normal and texture point."""
    visual: ColorVisuals | TextureVisuals
    if mesh.texture is not None:
        picture = Image.fromarray(np.asarray(mesh.texture.picture))
        picture.format = "JPEG"  # so that trimesh encodes it as such: six times faster than PNG
        material = PBRMaterial(baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=ROUGHNESS)
        visual = TextureVisuals(uv=mesh.texture.corner_uv.reshape(-1, 2), material=material)
    elif mesh.vertex_colors is not None:
        visual = ColorVisuals(vertex_colors=_convert_to_linear(mesh.vertex_colors[mesh.faces.reshape(-1)]))
    else:
        material = PBRMaterial(baseColorFactor=[*color, 255], metallicFactor=0.0, roughnessFactor=ROUGHNESS)
        visual = TextureVisuals(material=material)
    return trimesh.Trimesh(
        mesh.vertices[mesh.faces].reshape(-1, 3),
        np.arange(3 * len(mesh.faces)).reshape(-1, 3),
        vertex_normals=compute_corner_normals(mesh).reshape(-1, 3),
        visual=visual,
        process=False,
    )


def _convert_to_linear(colors: np.ndarray) -> np.ndarray:
    """Convert sRGB to linear RGBA, in which glTF has vertex colours. Shape (n, 4)."""
    share = np.asarray(colors, dtype=np.float64) / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    opaque = np.full((len(light), 1), 255, dtype=np.uint8)
    return np.concatenate([np.rint(255 * light).astype(np.uint8), opaque], axis=1)


def _export_glb(scene: trimesh.Scene, normals: bool) -> bytes:
    return scene.export(file_type="glb", include_normals=normals) if scene.geometry else b""
