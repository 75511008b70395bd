"""Rendering of training views on a CPU with embree: the tracer's labels, under one light without bounces."""

import numpy as np

from schemas.geometry import Camera, Pose, TriangleMesh
from tableverse_factory.evaluation.training.picture.builder import SceneTables
from tableverse_factory.evaluation.training.picture.columns import Instance, Material, Scene, View
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
            for view in np.flatnonzero(pack.views[:, View.SCENE] == scene):
                row = pack.views[view].astype(np.float64)
                rotation = row[View.AXES].reshape(3, 3)
                fx, fy, cx, cy = row[View.INTRINSICS]
                camera = Camera(fx, fy, cx, cy, width, height)
                hits = caster.cast(camera, Pose(row[View.EYE], quaternion_from_matrix(rotation)))
                at = np.unravel_index(hits.pixels, (height, width))
                paint = pack.materials[materials[hits.part]]
                side = (own[hits.part] == TABLE_TOP) & (hits.normals[:, 2] <= UP) & (hits.part == len(meshes) - 2)
                depth[view][at] = hits.depth
                ids[view][at] = np.where(side, TABLE_SIDE, own[hits.part])
                normals[view][at] = np.rint(127 * hits.normals @ rotation)
                gloss = 2 * paint[:, Material.SPECULAR] * (1 - paint[:, Material.ROUGHNESS])
                shine[view][at] = 255 * np.clip(np.maximum(paint[:, Material.CLEAR], gloss), 0, 1)
                light[view][(*at, slice(0, 3))] = 0.4 + np.clip(hits.normals @ LIGHT_DIRECTION, 0, 1)[:, None]
                light[view][(*at, slice(3, 6))] = paint[:, Material.COLOR] ** 2.2
        torch = import_torch()
        return Exposure(*(torch.from_numpy(each) for each in (light, depth, ids, normals, shine)))

    def _build_scene(self, pack: SceneTables, scene: int) -> tuple[list[TriangleMesh], np.ndarray, np.ndarray]:
        """Build the meshes of a scene, the last two its table and its room, with their ids and materials."""
        row = pack.scenes[scene].astype(np.float64)
        first = int(row[Scene.FIRST_INSTANCE])
        instances = pack.instances[first : first + int(row[Scene.INSTANCES])].astype(np.float64)
        meshes = [self._place_instance(each) for each in instances]
        meshes += [_make_table(row), _make_room(row)]
        ids = np.concatenate([instances[:, Instance.ID], [TABLE_TOP, 0]]).astype(np.uint8)
        materials = [*instances[:, Instance.MATERIAL], row[Scene.TABLE_MATERIAL], row[Scene.FLOOR]]
        return meshes, ids, np.array(materials, dtype=int)

    def _place_instance(self, instance: np.ndarray) -> TriangleMesh:
        to_local = instance[Instance.TO_LOCAL].reshape(3, 4)
        corners = self._tables.get_triangles(int(instance[Instance.ROOT])).reshape(-1, 3)
        placed = np.linalg.solve(to_local[:, :3], (corners - to_local[:, 3]).T).T
        return TriangleMesh(placed, np.arange(len(placed), dtype=np.int32).reshape(-1, 3))


def _make_table(row: np.ndarray) -> TriangleMesh:
    (half_x, half_y), thick = row[Scene.HALF_SIZE], float(row[Scene.THICKNESS])
    place = (*row[Scene.TABLE_XY], -thick)
    if row[Scene.TABLE_KIND] < 0.5:
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int32))
    if row[Scene.TABLE_KIND] > 1.5:
        return revolve(np.array([[half_x, 0.0], [half_x, thick]])).translate(place).to_mesh()
    return make_block((2 * half_x, 2 * half_y, thick)).translate(place).to_mesh()


def _make_room(row: np.ndarray) -> TriangleMesh:
    low, high = row[Scene.ROOM_LOW], row[Scene.ROOM_HIGH]
    (x, y, z), (width, depth, height) = low, high - low
    return make_prism([(width, depth)], 0.0, height).translate((x + width / 2, y + depth / 2, z)).to_mesh()
