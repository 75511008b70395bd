"""Objects of an exported scene, the input of grasps, placements and motions.

Meshes and convex pieces are read from `assets/`, poses from the rows of objects/, and the table from `scene.xml`, where
it is wider than in `meta.json` if objects stood at its edge. Nothing is compiled.
"""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from schemas.geometry import Frozen, Pose, TriangleMesh
from schemas.identity import make_file_stem
from tableverse_factory.core.errors import InputError
from tableverse_factory.geometry.math.transforms import normalize_quaternion
from tableverse_factory.geometry.mesh.meshes import place_mesh, read_mesh
from tableverse_factory.geometry.relations.relations import BodyFeatures, compute_body_features
from tableverse_factory.physics.mjcf.file_check import check_references
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.mjcf.spec import ASSETS, TABLE

MAX_PIECES = 1000
_POSITION, _QUATERNION = ("x_m", "y_m", "z_m"), ("qw", "qx", "qy", "qz")
_TEXTURE_AND_NORMALS = re.compile(rb"^v[tn] [^\n]*\n|/[0-9]*", re.MULTILINE)  # without, it is read ten times as fast


@dataclass(frozen=True, slots=True, eq=False)
class SceneObject(Frozen):
    """One object of an exported scene: its mesh, without colours, and pieces in its own frame [m].

    `standing` is the mesh in the table frame, and `body` the features of that.
    """

    object_id: str
    mesh: TriangleMesh
    hulls: tuple[TriangleMesh, ...]
    pose: Pose
    mass_kg: float
    standing: TriangleMesh
    body: BodyFeatures


def load_scene_objects(files: Mapping[str, bytes], object_rows: Iterable[Mapping[str, Any]]) -> dict[str, SceneObject]:
    """Load the objects of a scene by id, in the order of its rows of objects/.

    Raises:
        InputError: `bad_scene` if a row names no file, or its pose or mass is no number.
        GeometryError: if a mesh does not decode.
    """
    return {str(row["object_id"]): _load_object(files, row) for row in object_rows}


def read_slab(files: Mapping[str, bytes]) -> Slab:
    """Read the table-top of `scene.xml`: its rectangle on z = 0; InputError `bad_mjcf` without one."""
    check_references(files.get("scene.xml", b""), files.keys())
    try:
        spec = mujoco.MjSpec.from_string(files["scene.xml"].decode())
    except (KeyError, ValueError, UnicodeDecodeError) as error:
        raise InputError(f"scene.xml does not parse: {type(error).__name__}: {error}"[:300], "bad_mjcf") from error
    body, geom = spec.body(TABLE), spec.geom(TABLE)
    if body is None or geom is None or geom.type != mujoco.mjtGeom.mjGEOM_BOX:
        raise InputError(f"scene.xml has no box named {TABLE!r} to put things on", "bad_mjcf")
    w, _, _, z = normalize_quaternion(np.array(body.quat, dtype=np.float64))
    red, green, blue = (int(np.clip(np.rint(255 * value), 0, 255)) for value in geom.rgba[:3])
    center, half = np.array(body.pos[:2], dtype=np.float64), np.array(geom.size[:2], dtype=np.float64)
    return Slab(center, half, float(2 * np.arctan2(z, w)), (red, green, blue))


def load_mesh(files: Mapping[str, bytes], object_id: str) -> TriangleMesh:
    """Load the mesh of one object in its own frame, without colours; InputError `bad_scene` if there is none."""
    return _read_asset_mesh(files, f"{ASSETS}/{make_file_stem(object_id)}.obj")


def make_scene_object(
    object_id: str, mesh: TriangleMesh, hulls: tuple[TriangleMesh, ...], pose: Pose, mass_kg: float
) -> SceneObject:
    """Make an object of its mesh and pieces at `pose`."""
    standing = place_mesh(mesh, pose)
    return SceneObject(object_id, mesh, hulls, pose, mass_kg, standing, compute_body_features(standing))


def _load_object(files: Mapping[str, bytes], row: Mapping[str, Any]) -> SceneObject:
    object_id, stem = str(row["object_id"]), make_file_stem(str(row["object_id"]))
    try:
        numbers = np.array([row[key] for key in (*_POSITION, *_QUATERNION, "mass_kg")], dtype=np.float64)
        pose = Pose(numbers[:3], normalize_quaternion(numbers[3:7]))
        count = int(row["n_pieces"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{object_id}: its row has no pose: {error}"[:300], "bad_scene") from error
    if not np.isfinite(numbers).all() or not 0 < count <= MAX_PIECES:
        raise InputError(f"{object_id}: its row holds what is no pose, mass or number of pieces", "bad_scene")
    pieces = tuple(_read_asset_mesh(files, f"{ASSETS}/{stem}_piece_{index:02d}.obj") for index in range(count))
    return make_scene_object(object_id, load_mesh(files, object_id), pieces, pose, float(numbers[7]))


def _read_asset_mesh(files: Mapping[str, bytes], name: str) -> TriangleMesh:
    if name not in files:
        raise InputError(f"there is no {name}", "bad_scene")
    return read_mesh(_TEXTURE_AND_NORMALS.sub(b"", files[name]), name)
