"""Pool of the generator's meshes and of settled arrangements, one file that a GPU machine reads with numpy alone."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Self

import numpy as np
from jaxtyping import Float32, Float64, Int32, UInt8, UInt16

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.training.packed_arrays import refuse_damaged, write_arrays

STEPS = 65535  # of a coordinate across its mesh
SCENES_AT_A_TIME = 2


@dataclass(frozen=True, slots=True, eq=False)
class MeshPool:
    """Meshes end to end, quantised, and the arrangements in which they came to rest.

    Attributes:
        vertices: In steps of each mesh's box. Shape (v, 3).
        faces: Indices into the mesh's own vertices. Shape (f, 3).
        ends: Past each mesh's last vertex and last face. Shape (m, 2).
        low: Lowest corner of each mesh [m]. Shape (m, 3).
        size: Extents of each mesh [m]. Shape (m, 3).
        shiny: 0 for matt to 255 for polished metal. Shape (m,).
        hollow: Whether it is a vessel, whose inside may have another colour. Shape (m,).
        scene: Index of the arrangement of each mesh. Shape (m,).
        poses: Position [m] and quaternion wxyz of each mesh at rest on the table z = 0. Shape (m, 7).
    """

    vertices: UInt16[np.ndarray, "v 3"]
    faces: UInt16[np.ndarray, "f 3"]
    ends: Int32[np.ndarray, "m 2"]
    low: Float32[np.ndarray, "m 3"]
    size: Float32[np.ndarray, "m 3"]
    shiny: UInt8[np.ndarray, " m"]
    hollow: UInt8[np.ndarray, " m"]
    scene: Int32[np.ndarray, " m"]
    poses: Float32[np.ndarray, "m 7"]

    def __len__(self) -> int:
        return len(self.ends)

    def get_mesh(self, index: int) -> tuple[Float64[np.ndarray, "n 3"], Int32[np.ndarray, "k 3"]]:
        """Decode vertices [m] and faces of one mesh."""
        start = self.ends[index - 1] if index else np.zeros(2, dtype=np.int32)
        end = self.ends[index]
        steps = self.vertices[start[0] : end[0]].astype(np.float64) / STEPS
        return self.low[index] + steps * self.size[index], self.faces[start[1] : end[1]].astype(np.int32)

    def write(self, path: Path) -> None:
        """Write the pool, at once or not at all."""
        write_arrays(path, {field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a pool that `write` wrote; raise an `InputError` if the file is not one."""
        with refuse_damaged(path, "a pool of meshes", "remove it"), np.load(path, allow_pickle=False) as file:
            return cls(**{field.name: file[field.name] for field in fields(cls)})


def make_pool(scenes: int, seed: int, on_scene: Callable[[], object] = lambda: None, jobs: int = 1) -> MeshPool:
    """Make the objects of `scenes` arrangements and let each come to rest; depends on scenes and seed alone."""
    from tableverse_factory.core.process_pool import parallel_map

    rows = []
    for own in parallel_map(partial(_settle_scene, seed), range(scenes), jobs, "makes meshes", SCENES_AT_A_TIME):
        rows += own
        on_scene()
    return pack_meshes(rows)


PoolRow = tuple[np.ndarray, np.ndarray, float, bool, int, np.ndarray]  # vertices, faces, shiny, hollow, scene, pose


def pack_meshes(rows: list[PoolRow]) -> MeshPool:
    """Pack meshes into a pool; those of more than 65,535 vertices are refused."""
    vertices, faces, low, size = [], [], [], []
    for points, triangles, *_ in rows:
        if len(points) > STEPS:
            raise InputError(f"a mesh of the pool has {len(points)} vertices; at most {STEPS}")
        low.append(points.min(axis=0))
        size.append(np.maximum(np.ptp(points, axis=0), 1e-6))
        vertices.append(np.round((points - low[-1]) / size[-1] * STEPS).astype(np.uint16))
        faces.append(triangles.astype(np.uint16))
    counts = np.array([[len(a), len(b)] for a, b in zip(vertices, faces, strict=True)])
    _, _, shiny, hollow, scene, poses = zip(*rows, strict=True)
    return MeshPool(
        vertices=np.concatenate(vertices),
        faces=np.concatenate(faces),
        ends=np.cumsum(counts, axis=0).astype(np.int32),
        low=np.array(low, dtype=np.float32),
        size=np.array(size, dtype=np.float32),
        shiny=np.round(255 * np.array(shiny)).astype(np.uint8),
        hollow=np.array(hollow, dtype=np.uint8),
        scene=np.array(scene, dtype=np.int32),
        poses=np.array(poses, dtype=np.float32),
    )


def _settle_scene(seed: int, index: int) -> list[PoolRow]:
    """Arrange one scene; on the GPU machine nothing of the generator is needed, hence the imports here."""
    from tableverse_factory.sources.synthetic.scene import arrange_scene

    name = f"pool_{index:06d}"
    placed, _ = arrange_scene(make_rng(seed, name, "train"), name)
    return [
        (
            np.asarray(item.model.mesh.vertices),
            np.asarray(item.model.mesh.faces),
            item.model.shiny,
            item.model.cavity is not None,
            index,
            np.concatenate([item.pose.position, item.pose.quaternion_wxyz]),
        )
        for item in placed
    ]
