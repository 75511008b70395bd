"""GLB of a scene: a node per object at its settled pose, table included, with textures and normals; Y-up as in glTF."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import IO, ClassVar

import numpy as np
import trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from schemas.geometry import Texture, TriangleMesh
from tableverse_factory.core.png import encode_png
from tableverse_factory.delivery.formats.model_contents import ModelContents, ModelObject, VisualMesh
from tableverse_factory.geometry.math.transforms import Y_UP_TO_Z_UP, homogeneous_matrix, matrix_from_pose
from tableverse_factory.geometry.mesh.distinct_rows import find_distinct_rows
from tableverse_factory.physics.render.normals import compute_corner_normals

ROUGHNESS = 0.8
_NORMAL_DECIMALS = 4


@dataclass(frozen=True, slots=True, eq=False)
class _Picture:
    """Picture (h, w, 3) as trimesh asks for it; its own compression takes twice the time and saves 3 %."""

    pixels: np.ndarray
    format: ClassVar[str] = "PNG"

    def save(self, file: IO[bytes], format: str) -> None:  # noqa: A002, ARG002 - names of Pillow's method
        file.write(encode_png(self.pixels))

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        """Give the pixels, by which trimesh finds equal materials."""
        return np.array(self.pixels, dtype=dtype, copy=copy)


def encode_glb(contents: ModelContents, labels: Mapping[str, str]) -> bytes:
    """Encode the file. Nodes are named after bodies; each mesh is in its object's own frame.

    `labels` by object name go into the nodes' `extras`, where JSON holds any text.
    """
    scene = trimesh.Scene(base_frame="scene")
    for content in (*contents.objects, *contents.still):
        _add_object(scene, content, labels.get(content.name))
    return scene.export(file_type="glb", include_normals=True)


def _add_object(scene: trimesh.Scene, content: ModelObject, label: str | None) -> None:
    pose = homogeneous_matrix(Y_UP_TO_Z_UP.T) @ matrix_from_pose(content.pose)
    extras = {} if label is None else {"metadata": {"label": label}}
    meshes = [_build_mesh(look) for look in content.looks]
    if len(meshes) == 1:
        scene.add_geometry(meshes[0], node_name=content.name, geom_name=content.name)
        scene.graph.update(content.name, matrix=pose, geometry=content.name, **extras)
        return
    scene.graph.update(content.name, matrix=pose, **extras)
    for index, mesh in enumerate(meshes):
        part = f"{content.name}/{index}"
        scene.add_geometry(mesh, node_name=part, geom_name=part, parent_node_name=content.name)


def _build_mesh(look: VisualMesh) -> trimesh.Trimesh:
    texture = look.mesh.texture
    vertices, faces, normals, uv = split_corners(look.mesh, texture)
    if texture is None:
        color = [*look.color, 255]
        material = PBRMaterial(baseColorFactor=color, metallicFactor=0.0, roughnessFactor=ROUGHNESS)
    else:
        picture = _Picture(np.asarray(texture.picture))
        material = PBRMaterial(baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=ROUGHNESS)
    visual = TextureVisuals(uv=uv, material=material)
    return trimesh.Trimesh(vertices, faces, vertex_normals=normals, visual=visual, process=False)


def split_corners(
    mesh: TriangleMesh, texture: Texture | None
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray | None]:
    """Return vertices, faces, and a unit normal and a texture coordinate per vertex.

    Vertices are duplicated where faces disagree on either: at creases and seams.
    """
    normals = np.round(compute_corner_normals(mesh).reshape(-1, 3), _NORMAL_DECIMALS) + 0.0
    normals[~normals.any(axis=1)] = (0.0, 0.0, 1.0)  # of faces without area
    uv = np.zeros((len(normals), 0)) if texture is None else texture.corner_uv.reshape(-1, 2)
    corners = np.column_stack([mesh.faces.reshape(-1), normals, uv])
    distinct, index = find_distinct_rows(corners)
    vertices, sides = mesh.vertices[distinct[:, 0].astype(np.int64)], distinct[:, 1:4]
    sides = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    return vertices, index.reshape(-1, 3), sides, None if texture is None else distinct[:, 4:]
