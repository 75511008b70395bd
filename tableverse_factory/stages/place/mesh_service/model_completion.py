"""The MeshModels with weights: objects go to a mesh process, its files come back as closed meshes of modest size."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from schemas.config import PlaceConfig
from schemas.geometry import Colors, TriangleMesh
from schemas.identity import content_hash
from schemas.objects import PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.math.axes import Y_UP_TO_Z_UP
from tableverse_factory.geometry.mesh.meshes import box_center, read_mesh
from tableverse_factory.geometry.mesh.repair import make_closed_solid
from tableverse_factory.geometry.mesh.voxel_solids import find_largest_part, from_manifold, simplify_solid
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.interfaces import Completion
from tableverse_factory.stages.place.mesh_service.client import Answer, MeshClient, MeshFile, MeshQuery, RgbdImage
from tableverse_factory.stages.place.view.object_view import ObjectView

MAX_FACES = 4000
"""Of a mesh that is kept: about what the embedded default makes."""
MAX_FACES_TAKEN = 2_000_000
"""Of a mesh that is worked on at all."""
TOLERANCE = 5e-4
"""How far simplification may move the surface at first, as a share of the longest side."""
_SEEDS = 2**31


def complete_with_model(
    scene: PerceivedObjects,
    views: Sequence[ObjectView],
    config: PlaceConfig,
    rng: np.random.Generator,
    services: Services,
) -> list[Completion | GeometryError]:
    """All objects of a scene in one request; pose and size are left to registration: a model's scale is not metric.

    Raises:
        ModelAccessError: if the process does not start.
        ModelError: if it answers nothing.
    """
    seen = scene.observation
    view = RgbdImage(seen.color, seen.depth, seen.camera)
    draw = int(rng.integers(2**63)).to_bytes(8, "little")
    orders = [_order(scene, sighting, draw) for sighting in views]
    if not orders:
        return []
    maker = MeshClient(config.mesh_command, config.mesh_timeout_s, services)
    return [_completion(answer, config.mesh_model) for answer in maker.make(view, orders)]


def mesh_of(answer: MeshFile) -> TriangleMesh:
    """The file as a closed mesh: z up, centred, its longest side 1, at most about `MAX_FACES` faces, its own colours.

    Raises:
        GeometryError: if it does not decode, is empty, not finite, too large, or encloses nothing.
    """
    mesh = read_mesh(answer.data, f"answer.{answer.format}")
    if len(mesh.faces) > MAX_FACES_TAKEN:
        raise GeometryError(f"a mesh of {len(mesh.faces)} triangles; at most {MAX_FACES_TAKEN} are taken of a model")
    low, high = aabb(mesh.vertices)
    vertices = (mesh.vertices - box_center(mesh)) / float((high - low).max())
    if answer.format == "glb" and answer.up == "z":  # reading has turned it, as the standard wants
        vertices = vertices @ Y_UP_TO_Z_UP
    if answer.format != "glb" and answer.up == "y":
        vertices = vertices @ Y_UP_TO_Z_UP.T
    upright = TriangleMesh(vertices, mesh.faces, _vertex_colors(mesh))
    solid, _ = make_closed_solid(upright)
    return _coloured(from_manifold(simplify_solid(find_largest_part(solid), MAX_FACES, TOLERANCE)), upright)


def _order(scene: PerceivedObjects, sighting: ObjectView, draw: bytes) -> MeshQuery:
    """Its seed depends on the scene's and on its own pixels, not on what else was found beside it."""
    mask = scene.instance_ids == sighting.instance_id
    seed = int(content_hash(draw, np.packbits(mask).tobytes())[:15], 16) % _SEEDS
    return MeshQuery(mask, seed)


def _completion(answer: Answer, name: str) -> Completion | GeometryError:
    if isinstance(answer, str):
        return GeometryError(answer)
    try:
        return Completion(mesh_of(answer), None, f"{name}/{answer.model}", answer.licence)
    except GeometryError as error:
        return error


def _vertex_colors(mesh: TriangleMesh) -> Colors | None:
    """The colours of the vertices, read from the texture where there is one."""
    if mesh.texture is None:
        return mesh.vertex_colors
    height, width = mesh.texture.picture.shape[:2]
    u, v = mesh.texture.corner_uv.reshape(-1, 2).T
    columns = np.clip((u * width).astype(np.int64), 0, width - 1)
    rows = np.clip(((1.0 - v) * height).astype(np.int64), 0, height - 1)
    colors = np.zeros((len(mesh.vertices), 3), dtype=np.uint8)
    colors[mesh.faces.reshape(-1)] = mesh.texture.picture[rows, columns]
    return colors


def _coloured(mesh: TriangleMesh, original: TriangleMesh) -> TriangleMesh:
    """Each vertex in the colour of the nearest of the original; as it is where that has none."""
    if original.vertex_colors is None:
        return mesh
    _, nearest = cKDTree(original.vertices, balanced_tree=False).query(mesh.vertices)
    return replace(mesh, vertex_colors=np.ascontiguousarray(original.vertex_colors[nearest]))
