"""Shape completion by a mesh process, whose files become closed meshes of modest size."""

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
from tableverse_factory.geometry.math.transforms import Y_UP_TO_Z_UP
from tableverse_factory.geometry.mesh.meshes import box_center, read_mesh
from tableverse_factory.geometry.mesh.repair import make_closed_solid
from tableverse_factory.geometry.mesh.texels import get_nearest_texels
from tableverse_factory.geometry.mesh.voxel_solids import find_largest_part, from_manifold, simplify_solid
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.interfaces import Completion
from tableverse_factory.stages.place.mesh_service.client import MeshAnswer, MeshClient, MeshFile, MeshQuery, RgbdImage
from tableverse_factory.stages.place.view.object_view import ObjectView

MAX_FACES = 4000  # maximum number of faces of a completed mesh
MAX_INPUT_FACES = 2_000_000  # maximum number of faces of a mesh that is accepted
TOLERANCE = 5e-4  # initial tolerance of simplification, as a share of the longest side
_SEEDS = 2**31


def complete_with_model(
    scene: PerceivedObjects,
    views: Sequence[ObjectView],
    config: PlaceConfig,
    rng: np.random.Generator,
    services: Services,
) -> list[Completion | GeometryError]:
    """Complete all objects of a scene; pose and size are left to registration, for models have no metric scale."""
    seen = scene.observation
    view = RgbdImage(seen.color, seen.depth, seen.camera)
    draw = int(rng.integers(2**63)).to_bytes(8, "little")
    queries = [_build_query(scene, object_view, draw) for object_view in views]
    if not queries:
        return []
    client = MeshClient(config.mesh_command, config.mesh_timeout_s, services)
    return [_convert_answer(answer, config.mesh_model) for answer in client.make_meshes(view, queries)]


def convert_mesh(answer: MeshFile) -> TriangleMesh:
    """Convert a file to a closed mesh: z up, centered, longest side 1, about `MAX_FACES` faces, with its colours.

    Raises:
        GeometryError: if it does not decode, is empty, not finite or too large, or encloses nothing.
    """
    mesh = read_mesh(answer.data, f"answer.{answer.format}")
    if len(mesh.faces) > MAX_INPUT_FACES:
        raise GeometryError(f"a mesh of {len(mesh.faces)} triangles; at most {MAX_INPUT_FACES} are taken of a model")
    low, high = aabb(mesh.vertices)
    vertices = (mesh.vertices - box_center(mesh)) / float((high - low).max())
    if answer.format == "glb" and answer.up == "z":  # the reader has turned it, as the standard says
        vertices = vertices @ Y_UP_TO_Z_UP
    if answer.format != "glb" and answer.up == "y":
        vertices = vertices @ Y_UP_TO_Z_UP.T
    upright = TriangleMesh(vertices, mesh.faces, _sample_vertex_colors(mesh))
    solid, _ = make_closed_solid(upright)
    return _transfer_colors(from_manifold(simplify_solid(find_largest_part(solid), MAX_FACES, TOLERANCE)), upright)


def _build_query(scene: PerceivedObjects, object_view: ObjectView, draw: bytes) -> MeshQuery:
    """Build a query whose seed depends on the scene's draw and the object's pixels, not on other objects."""
    mask = scene.instance_ids == object_view.instance_id
    seed = int(content_hash(draw, np.packbits(mask).tobytes())[:15], 16) % _SEEDS
    return MeshQuery(mask, seed)


def _convert_answer(answer: MeshAnswer, name: str) -> Completion | GeometryError:
    if isinstance(answer, str):
        return GeometryError(answer)
    try:
        return Completion(convert_mesh(answer), None, f"{name}/{answer.model}", answer.licence)
    except GeometryError as error:
        return error


def _sample_vertex_colors(mesh: TriangleMesh) -> Colors | None:
    if mesh.texture is None:
        return mesh.vertex_colors
    colors = np.zeros((len(mesh.vertices), 3), dtype=np.uint8)
    colors[mesh.faces.reshape(-1)] = get_nearest_texels(mesh.texture, mesh.texture.corner_uv.reshape(-1, 2))
    return colors


def _transfer_colors(mesh: TriangleMesh, original: TriangleMesh) -> TriangleMesh:
    if original.vertex_colors is None:
        return mesh
    _, nearest = cKDTree(original.vertices, balanced_tree=False).query(mesh.vertices)
    return replace(mesh, vertex_colors=np.ascontiguousarray(original.vertex_colors[nearest]))
