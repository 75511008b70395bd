"""Rendering of training views on a CPU with embree: the tracer's labels, under one light without bounces."""

import numpy as np

from schemas.geometry import Camera, Pose, TriangleMesh
from tableverse_factory.evaluation.training.picture.builder import SceneTables
from tableverse_factory.evaluation.training.picture.exposure import Exposure
from tableverse_factory.evaluation.training.picture.tables import TABLE_SIDE, TABLE_TOP, MeshTables
from tableverse_factory.geometry.math.transforms import quaternion_from_matrix
from tableverse_factory.models.local.device import import_torch
from tableverse_factory.physics.render.raycast import Raycaster
from tableverse_factory.sources.synthetic.solids import make_block, make_prism, revolve

UP = 0.99  # least z of a normal that points up
LIGHT_DIRECTION = np.array([0.3, 0.2, 0.93])


class CpuRenderer:
    """Casts one ray a pixel; for tests and small trials."""

    def __init__(self, tables: MeshTables, size: tuple[int, int]) -> None:
        self._tables = tables
        self._size = size

    def render(self, pack: SceneTables) -> Exposure:
        """Render every view of the pack."""
        width, height = self._size
        shape = (len(pack.views), height, width)
        light, normals = np.zeros((*shape, 9), np.float32), np.zeros((*shape, 3), np.int8)
        depth, ids, shine = np.zeros(shape, np.float32), np.zeros(shape, np.uint8), np.zeros(shape, np.uint8)
        for scene in range(len(pack.scenes)):
            meshes, own, materials = self._build_scene(pack, scene)
            caster = Raycaster(meshes)
            for view in np.flatnonzero(pack.views[:, 16] == scene):
                row = pack.views[view].astype(np.float64)
                rotation = row[3:12].reshape(3, 3)
                camera = Camera(row[12], row[13], row[14], row[15], width, height)
                hits = caster.cast(camera, Pose(row[:3], quaternion_from_matrix(rotation)))
                at = np.unravel_index(hits.pixels, (height, width))
                paint = pack.materials[materials[hits.part]]
                side = (own[hits.part] == TABLE_TOP) & (hits.normals[:, 2] <= UP) & (hits.part == len(meshes) - 2)
                depth[view][at] = hits.depth
                ids[view][at] = np.where(side, TABLE_SIDE, own[hits.part])
                normals[view][at] = np.rint(127 * hits.normals @ rotation)
                shine[view][at] = 255 * np.clip(np.maximum(paint[:, 15], 2 * paint[:, 14] * (1 - paint[:, 13])), 0, 1)
                light[view][(*at, slice(0, 3))] = 0.4 + np.clip(hits.normals @ LIGHT_DIRECTION, 0, 1)[:, None]
                light[view][(*at, slice(3, 6))] = paint[:, 6:9] ** 2.2
        torch = import_torch()
        return Exposure(*(torch.from_numpy(each) for each in (light, depth, ids, normals, shine)))

    def _build_scene(self, pack: SceneTables, scene: int) -> tuple[list[TriangleMesh], np.ndarray, np.ndarray]:
        """Build the meshes of a scene, the last two its table and its room, with their ids and materials."""
        row = pack.scenes[scene].astype(np.float64)
        first = int(row[1])
        instances = pack.instances[first : first + int(row[0])].astype(np.float64)
        meshes = [self._place_instance(each) for each in instances]
        meshes += [_make_table(row), _make_room(row)]
        ids = np.concatenate([instances[:, 20], [TABLE_TOP, 0]]).astype(np.uint8)
        return meshes, ids, np.concatenate([instances[:, 19], [row[8], row[15]]]).astype(int)

    def _place_instance(self, instance: np.ndarray) -> TriangleMesh:
        to_local = instance[:12].reshape(3, 4)
        corners = self._tables.get_triangles(int(instance[18])).reshape(-1, 3)
        placed = np.linalg.solve(to_local[:, :3], (corners - to_local[:, 3]).T).T
        return TriangleMesh(placed, np.arange(len(placed), dtype=np.int32).reshape(-1, 3))


def _make_table(row: np.ndarray) -> TriangleMesh:
    place, thick = (row[2], row[3], -row[4]), float(row[4])
    if row[7] < 0.5:
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
    if row[7] > 1.5:
        return revolve(np.array([[row[5], 0.0], [row[5], thick]])).translate(place).to_mesh()
    return make_block((2 * row[5], 2 * row[6], thick)).translate(place).to_mesh()


def _make_room(row: np.ndarray) -> TriangleMesh:
    size = row[12:15] - row[9:12]
    middle = (row[9:12] + row[12:15]) / 2
    return make_prism([(size[0], size[1])], 0.0, size[2]).translate((middle[0], middle[1], row[11])).to_mesh()
