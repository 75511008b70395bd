"""GLB of a scene: a node per object at its settled pose, table included, textures embedded, Y-up as in glTF."""

from collections.abc import Mapping

import numpy as np
import trimesh
from PIL import Image
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from schemas.geometry import Texture, TriangleMesh
from tableverse_factory.delivery.formats.model_contents import ModelContents, ModelObject, VisualMesh
from tableverse_factory.geometry.math.transforms import Y_UP_TO_Z_UP, homogeneous_matrix, matrix_from_pose

ROUGHNESS = 0.8


def encode_glb(contents: ModelContents, labels: Mapping[str, str]) -> bytes:
    """Encode the file. Nodes are named after bodies; each mesh is in its object's own frame.

    `labels` by object name go into the nodes' `extras`, where JSON holds any text.
    """
    scene = trimesh.Scene(base_frame="scene")
    for content in (*contents.objects, *contents.still):
        _add_object(scene, content, labels.get(content.name))
    return scene.export(file_type="glb", include_normals=False)


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
    mesh, texture = look.mesh, look.mesh.texture
    if texture is None:
        color = [*look.color, 255]
        material = PBRMaterial(baseColorFactor=color, metallicFactor=0.0, roughnessFactor=ROUGHNESS)
        return trimesh.Trimesh(mesh.vertices, mesh.faces, visual=TextureVisuals(material=material), process=False)
    vertices, faces, uv = split_at_seams(mesh, texture)
    picture = Image.fromarray(np.asarray(texture.picture))
    material = PBRMaterial(baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=ROUGHNESS)
    return trimesh.Trimesh(vertices, faces, visual=TextureVisuals(uv=uv, material=material), process=False)


def split_at_seams(mesh: TriangleMesh, texture: Texture) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return vertices, faces and a texture coordinate per vertex, duplicating vertices where faces disagree on it."""
    corners = np.column_stack([mesh.faces.reshape(-1), texture.corner_uv.reshape(-1, 2)])
    distinct, index = np.unique(corners, axis=0, return_inverse=True)
    vertices = mesh.vertices[distinct[:, 0].astype(np.int64)]
    return vertices, index.reshape(-1, 3).astype(np.int64), distinct[:, 1:]
