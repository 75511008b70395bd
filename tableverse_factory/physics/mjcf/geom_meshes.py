"""Geoms of a compiled MuJoCo model as triangles, and names of its bodies; readers of a scene need no solids."""

import mujoco
import numpy as np
import trimesh

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.meshes import from_trimesh
from tableverse_factory.physics.mjcf.scenery import read_mesh

_SEGMENTS = 48
_PLANE_REACH_M = 50.0


def name_body(model: mujoco.MjModel, body: int) -> str:
    """Name a body, or give `#` and its id where it has none."""
    return model.body(body).name or f"#{body}"


def make_geom_mesh(model: mujoco.MjModel, geom: int) -> TriangleMesh | None:
    """Make a geom's triangles in its own frame; None for types without volume of their own (height fields)."""
    kind, size = mujoco.mjtGeom(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        return read_mesh(model, int(model.geom_dataid[geom]))
    if kind == mujoco.mjtGeom.mjGEOM_PLANE:
        slab = trimesh.creation.box((2 * _PLANE_REACH_M, 2 * _PLANE_REACH_M, _PLANE_REACH_M))
        slab.apply_translation([0, 0, -_PLANE_REACH_M / 2])
        return from_trimesh(slab)
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return from_trimesh(trimesh.creation.box(2 * size))
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return from_trimesh(trimesh.creation.cylinder(size[0], 2 * size[1], sections=_SEGMENTS))
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return from_trimesh(trimesh.creation.capsule(2 * size[1], size[0], count=[_SEGMENTS // 2, _SEGMENTS]))
    if kind in (mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_ELLIPSOID):
        radii = np.full(3, size[0]) if kind == mujoco.mjtGeom.mjGEOM_SPHERE else size
        ball = from_trimesh(trimesh.creation.icosphere(4))
        return TriangleMesh(ball.vertices * radii, ball.faces)
    return None
