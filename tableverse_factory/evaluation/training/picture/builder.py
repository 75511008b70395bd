"""A scene under construction, and its rows once built; `columns.py` names what they hold."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from schemas.geometry import Frozen
from tableverse_factory.evaluation.training.picture.columns import Instance, Light, Material, Scene, View
from tableverse_factory.evaluation.training.picture.materials import TextureBook, make_thing_material
from tableverse_factory.evaluation.training.picture.tables import MeshTables, stack_rows
from tableverse_factory.evaluation.training.picture.things import Part, make_turn

MAX_THINGS = 250


@dataclass(frozen=True, slots=True, eq=False)
class SceneTables(Frozen):
    """Rows of one or more scenes, as the tracer reads them."""

    scenes: Float32[np.ndarray, "s 40"]
    instances: Float32[np.ndarray, "i 24"]
    materials: Float32[np.ndarray, "m 36"]
    lights: Float32[np.ndarray, "l 12"]
    views: Float32[np.ndarray, "v 20"]


class SceneBuilder:
    """Collects instances, materials, lights and views of one scene in the table's frame, z up [m]."""

    def __init__(self, tables: MeshTables, book: TextureBook) -> None:
        self.tables = tables
        self.book = book
        self.row = np.zeros(Scene.WIDTH, dtype=np.float32)
        self.lights: list[np.ndarray] = []
        self.views: list[np.ndarray] = []
        self.boxes: list[np.ndarray] = []  # low and high corner of each thing that has an id [m]
        self._instances: list[np.ndarray] = []
        self._materials: list[np.ndarray] = []

    def add_material(self, row: np.ndarray) -> int:
        """Add a material and return its index."""
        self._materials.append(row)
        return len(self._materials) - 1

    def add_mesh(self, mesh: int, map_: np.ndarray, offset: np.ndarray, material: int, id_: int = 0) -> np.ndarray:
        """Add a mesh under an affine map; return the corners of its box in the table's frame [m]. Shape (2, 3)."""
        row = np.zeros(Instance.WIDTH, dtype=np.float32)
        inverse = np.linalg.inv(map_)
        row[Instance.TO_LOCAL] = np.column_stack([inverse, -inverse @ offset]).ravel()
        low, high = self.tables.low[mesh], self.tables.high[mesh]
        corners = np.array([[x, y, z] for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
        moved = corners @ map_.T + offset
        box = np.stack([moved.min(axis=0) - 1e-4, moved.max(axis=0) + 1e-4])
        row[Instance.BOX] = box.ravel()
        row[Instance.ROOT], row[Instance.MATERIAL], row[Instance.ID] = self.tables.roots[mesh], material, id_
        self._instances.append(row)
        return box

    def add_parts(self, rng: np.random.Generator, parts: Sequence[Part], id_: int) -> None:
        """Add the parts of a thing; those without a material of their own share the first one's."""
        first, boxes = -1, []
        for part in parts:
            material = first
            if first < 0 or part.own_material:
                low, high = self.tables.low[part.mesh], self.tables.high[part.mesh]
                hollow, shiny = bool(self.tables.hollow[part.mesh]), float(self.tables.shiny[part.mesh])
                row = make_thing_material(rng, self.book, low, high, hollow, shiny, part.printed)
                material = self.add_material(row)
                first = material if first < 0 else first
            boxes.append(self.add_mesh(part.mesh, part.map_, part.offset, material, id_))
        if id_:
            self.boxes.append(np.stack([np.min(boxes, axis=0)[0], np.max(boxes, axis=0)[1]]))

    def add_box(self, size: Sequence[float], offset: Sequence[float], material: int, yaw: float = 0.0) -> None:
        """Add a box about its foot that is no thing."""
        mesh = self.tables.find("box")[0]
        self.add_mesh(mesh, make_turn(2, yaw) @ np.diag(np.asarray(size, dtype=float)), np.asarray(offset), material)

    def add_limb(self, start: np.ndarray, end: np.ndarray, radius: float, material: int) -> None:
        """Add a capsule from one point to another [m]."""
        axis = end - start
        length = max(float(np.linalg.norm(axis)), 1e-4)
        forward = axis / length
        side = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9 else [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        map_ = np.stack([side, np.cross(forward, side), forward], axis=1) @ np.diag([2 * radius, 2 * radius, length])
        self.add_mesh(self.tables.find("limb")[0], map_, start, material)

    def measure_things(self) -> tuple[np.ndarray, np.ndarray]:
        """Measure the box of all things [m]; a small one about the origin without any."""
        if not self.boxes:
            return np.array([-0.1, -0.1, 0.0]), np.array([0.1, 0.1, 0.05])
        return np.min([box[0] for box in self.boxes], axis=0), np.max([box[1] for box in self.boxes], axis=0)

    def build(self) -> SceneTables:
        """Return the rows."""
        self.row[Scene.INSTANCES], self.row[Scene.LIGHTS] = len(self._instances), len(self.lights)
        views = np.array(self.views, dtype=np.float32).reshape(-1, View.WIDTH)
        views[:, View.HAS_TABLE], views[:, View.THINGS] = self.row[Scene.TABLE_KIND] > 0.5, len(self.boxes)
        return SceneTables(
            self.row[None].copy(),
            stack_rows(self._instances, Instance.WIDTH),
            stack_rows(self._materials, Material.WIDTH),
            stack_rows(self.lights, Light.WIDTH),
            views,
        )


def join_scenes(scenes: Sequence[SceneTables]) -> SceneTables:
    """Join scenes: indices of instances, materials, lights and scenes are moved."""
    parts: list[list[np.ndarray]] = [[], [], [], [], []]
    instances = materials = lights = 0
    for index, each in enumerate(scenes):
        row, own, views = each.scenes.copy(), each.instances.copy(), each.views.copy()
        row[0, Scene.FIRST_INSTANCE], row[0, Scene.FIRST_LIGHT] = instances, lights
        row[0, [Scene.TABLE_MATERIAL, Scene.FLOOR, Scene.WALL, Scene.CEILING, Scene.OTHER_WALL]] += materials
        own[:, Instance.MATERIAL] += materials
        views[:, View.SCENE] = index
        for part, rows in zip(parts, (row, own, each.materials, each.lights, views), strict=True):
            part.append(rows)
        instances, materials, lights = instances + len(own), materials + len(each.materials), lights + len(each.lights)
    return SceneTables(*(np.ascontiguousarray(np.concatenate(part)) for part in parts))
