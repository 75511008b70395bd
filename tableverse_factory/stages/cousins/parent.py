"""Scene of a dataset as a layout again: its meshes with their colours, convex pieces and poses, from its own files."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from schemas.config import ObserveConfig
from schemas.geometry import ConvexPieces, Frozen, Pose, Texture, TriangleMesh
from schemas.identity import make_file_stem
from schemas.objects import PlacedObject, Table
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.untrusted import decode_image, open_image
from tableverse_factory.dataset.scene import Scene
from tableverse_factory.geometry.math.transforms import normalize_quaternion
from tableverse_factory.geometry.mesh.meshes import check_mesh
from tableverse_factory.geometry.mesh.plain_obj import CornerUv, read_plain_obj, read_textured_obj
from tableverse_factory.physics.mjcf.slab import Slab, fit_slab
from tableverse_factory.physics.mjcf.spec import ASSETS

Row = Mapping[str, Any]

POSE_COLUMNS = (("x_m", "y_m", "z_m"), ("qw", "qx", "qy", "qz"))


@dataclass(frozen=True, slots=True, eq=False)
class ParentScene(Frozen):
    """A scene with its objects at scale 1 where they came to rest; its table is the slab that was exported."""

    table: Table
    objects: tuple[PlacedObject, ...]
    perception: str


def read_parent(scene: Scene, bounds: ObserveConfig) -> ParentScene:
    """Read a finished scene; InputError or GeometryError if its files are not those of one."""
    objects = tuple(read_scene_object(scene, row, bounds) for row in scene.object_rows())
    if not objects:
        raise InputError(f"scene {scene.scene_id} has no objects", "bad_scene")
    seen = _read_table(scene)
    slab = fit_slab(seen, [o.mesh for o in objects], [o.pose for o in objects], [1.0] * len(objects))
    return ParentScene(_make_table(slab, seen), objects, str(scene.row["perception"]))


def read_scene_object(scene: Scene, row: Row, bounds: ObserveConfig) -> PlacedObject:
    """Read one object of a scene by its row of objects/, with the texture or colour that it was exported with."""
    object_id = str(row["object_id"])
    return PlacedObject(
        object_id=object_id,
        label=str(row["label"]),
        label_confidence=float(row["label_confidence"]),
        mesh=_read_mesh(scene, object_id, bounds),
        scale=1.0,
        pose=_read_pose(row),
        contained_in=row["contained_in"],
        fit_residual_m=float(row["fit_residual_m"]),
        completion=str(row["completion"]),
        mesh_licence=row["mesh_licence"],
        pieces=_read_pieces(scene, row),
    )


def _read_pose(row: Row) -> Pose:
    position, quaternion = (np.array([row[key] for key in keys], dtype=np.float64) for keys in POSE_COLUMNS)
    return Pose(position, normalize_quaternion(quaternion))


def _read_pieces(scene: Scene, row: Row) -> ConvexPieces:
    stem = make_file_stem(str(row["object_id"]))
    names = (f"{ASSETS}/{stem}_piece_{index:02d}.obj" for index in range(int(row["n_pieces"])))
    return ConvexPieces(
        tuple(_read_obj(scene, name)[0] for name in names),
        float(row["piece_volume_ratio"]),
        float(row["piece_hausdorff_m"]),
        str(row["piece_method"]),
        str(row["mesh_repaired"]),
        float(row["piece_uncovered_m"]),
        float(row["cavity_kept"]),
    )


def _read_mesh(scene: Scene, object_id: str, bounds: ObserveConfig) -> TriangleMesh:
    """Read a mesh with its texture; one without has the colour of its geom at every vertex."""
    name = f"{ASSETS}/{make_file_stem(object_id)}"
    mesh, corner_uv = _read_obj(scene, f"{name}.obj")
    if corner_uv is None:
        color = np.array(_read_color(scene, object_id), dtype=np.uint8)
        return replace(mesh, vertex_colors=np.tile(color, (len(mesh.vertices), 1)))
    image = open_image(_read_file(scene, f"{name}.png"), f"{name}.png", bounds, "bad_texture")
    return replace(mesh, texture=Texture(decode_image(image, f"{name}.png", "RGB", "bad_texture"), corner_uv))


def _read_obj(scene: Scene, name: str) -> tuple[TriangleMesh, CornerUv | None]:
    data = _read_file(scene, name)
    if (plain := read_plain_obj(data)) is not None:
        return check_mesh(plain, name), None
    if (textured := read_textured_obj(data)) is None:
        raise InputError(f"scene {scene.scene_id}: {name} is no mesh that this program exports", "bad_mesh")
    check_mesh(textured[0], name)
    return textured


def _read_file(scene: Scene, name: str) -> bytes:
    files = scene.files()
    if name not in files:
        raise InputError(f"scene {scene.scene_id} has no {name}", "bad_scene")
    try:
        exported = scene.meta["files"][name]["sha256"]
    except (KeyError, TypeError):
        exported = None
    if hashlib.sha256(files[name]).hexdigest() != exported:
        raise InputError(f"scene {scene.scene_id}: {name} is not the file that was exported: restore it", "bad_scene")
    return files[name]


def _read_color(scene: Scene, object_id: str) -> tuple[int, ...]:
    """Read the colour of an object's visual geom, sRGB."""
    found = re.search(rf'<geom [^>]*name="{re.escape(object_id)}"[^>]*rgba="([0-9. e-]+)"', scene.xml)
    try:
        values = [float(value) for value in found[1].split()[:3]] if found else []
    except ValueError:
        values = []
    if len(values) != 3:
        raise InputError(f"scene {scene.scene_id}: scene.xml has no colour of {object_id}", "bad_mjcf")
    return tuple(int(np.clip(np.rint(255.0 * value), 0, 255)) for value in values)


def _read_table(scene: Scene) -> Table:
    try:
        table = scene.meta["table"]
        center, half = (np.array(table[key], dtype=np.float64) for key in ("center_xy", "half_size_xy"))
        numbers = np.array([*center, *half, table["yaw"], table["rms_m"]], dtype=np.float64)
        red, green, blue = (int(value) for value in table["color"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"scene {scene.scene_id}: meta.json has no table: {error}"[:300], "bad_meta") from error
    if numbers.shape != (6,) or not np.isfinite(numbers).all() or not 0.0 < half.min() <= half.max() < 100.0:
        raise InputError(f"scene {scene.scene_id}: the table of meta.json makes no sense", "bad_meta")
    return Table(center, half, float(numbers[4]), (red, green, blue), float(numbers[5]))


def _make_table(slab: Slab, seen: Table) -> Table:
    return Table(slab.center_xy, slab.half_size_xy, slab.yaw, slab.color, seen.rms_m)
