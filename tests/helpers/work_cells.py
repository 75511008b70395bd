"""Small work cells whose truth can be measured without the code under test."""

from collections.abc import Sequence
from functools import lru_cache

import mujoco
import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.geometry import Pose, TriangleMesh
from tableverse_factory.geometry.math.transforms import (
    compose_poses,
    invert_pose,
    quaternion_about_z,
    quaternion_from_matrix,
    rotation_matrix,
)
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.mjcf.spec import make_scene_body, make_scene_files
from tableverse_factory.robotics.motion.world import CollisionWorld
from tableverse_factory.robotics.robots.panda import build_panda
from tableverse_factory.robotics.robots.station import Station
from tests.helpers.simple_scenes import Solid, box, cylinder

CONFIG = TrajectoriesConfig()
HOME = np.array(build_panda().home)
BLOCK = "obj_000"
WIDTH_M = 0.05
GRASP_M = 0.07
"""Height of the TCP in the grasp of a block of 0.1 m."""


def station_of(solids: Sequence[Solid], mass_kg: float = 0.2) -> Station:
    hulls = [solid.hulls or (solid.mesh,) for solid in solids]
    bodies = [
        make_scene_body(s.object_id or f"obj_{k:03d}", s.mesh, h, 1.0, mass_kg, s.pose)
        for k, (s, h) in enumerate(zip(solids, hulls, strict=True))
    ]
    files = make_scene_files(bodies, Slab(np.zeros(2), np.array([0.45, 0.35]), 0.0, (150, 120, 90)))
    return Station({"scene.xml": files.xml.encode(), **files.assets}, build_panda())


def block(x: float, y: float) -> Solid:
    return Solid(box(WIDTH_M, WIDTH_M, 0.1), (x, y, 0.05), object_id=BLOCK)


@lru_cache(maxsize=1)
def clutter() -> CollisionWorld:
    """A block to move and four posts around it."""
    posts = [(0.12, 0.05), (-0.14, 0.08), (0.02, -0.15), (0.22, -0.1)]
    return CollisionWorld(station_of([block(0.0, 0.0), *(Solid(cylinder(0.03, 0.14), (x, y, 0.07)) for x, y in posts)]))


@lru_cache(maxsize=1)
def alone() -> CollisionWorld:
    return CollisionWorld(station_of([block(0.0, 0.0)]))


def down(x: float, y: float, z: float, yaw: float = 0.0) -> Pose:
    """The gripper from above, closing along the table's y at yaw 0."""
    rotation = rotation_matrix(quaternion_about_z(yaw)) @ np.diag([1.0, -1.0, -1.0])
    return Pose(np.array([x, y, z]), quaternion_from_matrix(rotation))


def open_box() -> tuple[TriangleMesh, ...]:
    """Walls and floor of a box that is open above, 0.3 m wide and 0.1 m high, as its pieces."""
    low, thick = 0.15, 0.01
    walls = [((2 * low, thick, 0.1), (0, s * low, 0)) for s in (-1, 1)]
    walls += [((thick, 2 * low, 0.1), (s * low, 0, 0)) for s in (-1, 1)]
    walls.append(((2 * low, 2 * low, thick), (0, 0, -0.045)))
    return tuple(TriangleMesh(box(*size).vertices + np.array(at), box(*size).faces) for size, at in walls)


def deepest(world: CollisionWorld, q: np.ndarray, opening: float, held: Pose | None, hull_ids: Sequence[int]) -> float:
    """Least signed distance of what moves to what does not, by MuJoCo's distance of every pair of geoms.

    `hull_ids` are the geoms of the object; `held` its frame in the gripper, or None while it is an obstacle. Pairs of
    the gripper with what it holds, of the held object with the table and of links with links are left out.
    """
    station = world.station
    model, data = station.model, station.data()
    station.set_arm(data, q, opening)
    mujoco.mj_kinematics(model, data)
    if held is not None:
        tcp = Pose(
            np.array(data.site_xpos[station.tcp_site]),
            quaternion_from_matrix(data.site_xmat[station.tcp_site].reshape(3, 3)),
        )
        pose, at = compose_poses(tcp, held), station.object_qpos[BLOCK]
        data.qpos[at : at + 3], data.qpos[at + 3 : at + 7] = pose.position, pose.quaternion_wxyz
        mujoco.mj_kinematics(model, data)
    links = [
        g
        for g in range(model.ngeom)
        if model.geom_bodyid[g] in station.arm_bodies
        and model.body_weldid[model.geom_bodyid[g]] != 0
        and (model.geom_contype[g] or model.geom_conaffinity[g])
    ]
    scene = [g for g in range(model.ngeom) if model.geom_bodyid[g] not in station.arm_bodies and g not in hull_ids]
    others = [g for g in scene if model.geom(g).name != "table"]
    pairs = [(a, b) for a in links for b in (scene if held is not None else [*scene, *hull_ids])]
    pairs += [(a, b) for a in hull_ids for b in others] if held is not None else []
    return min(mujoco.mj_geomDistance(model, data, a, b, 0.05, None) for a, b in pairs)


def object_geoms(world: CollisionWorld) -> list[int]:
    body = world.station.object_bodies[BLOCK]
    first, count = world.station.model.body_geomadr[body], world.station.model.body_geomnum[body]
    return list(range(int(first), int(first + count)))


def held_pose(tcp: Pose, standing: Pose) -> Pose:
    return compose_poses(invert_pose(tcp), standing)
