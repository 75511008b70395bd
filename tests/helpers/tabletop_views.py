"""Depth pictures of boxes and bowls on a table, cast ray by ray: every distance is known on paper."""

from dataclasses import dataclass

import numpy as np

from schemas.config import Config
from schemas.geometry import Camera, Pose
from schemas.observation import Observation
from tableverse_factory.geometry.math.transforms import (
    invert_pose,
    pose_from_matrix,
    quaternion_about_z,
    rotation_matrix,
    transform_points,
)

CAMERA = Camera(525.0, 525.0, 319.5, 239.5, 640, 480)
SMALL_CAMERA = Camera(262.5, 262.5, 159.5, 119.5, 320, 240)  # the same view in a quarter of the pixels
GEOMETRIC = Config.model_validate({"perceive": {"detector": "geometric"}})
FAR = 100.0


@dataclass(frozen=True)
class Box:
    """A box standing at (x, y), its lower face at z, turned about the vertical."""

    x: float
    y: float
    size: tuple[float, float, float]
    z: float = 0.0
    yaw: float = 0.0
    color: tuple[int, int, int] = (200, 40, 40)

    def hit(self, origin, rays):
        pose = Pose(np.array([self.x, self.y, self.z]), quaternion_about_z(self.yaw))
        start = transform_points(invert_pose(pose), origin[None])[0]
        direction = rays @ rotation_matrix(pose.quaternion_wxyz)
        low = np.array([-self.size[0] / 2, -self.size[1] / 2, 0.0])
        high = np.array([self.size[0] / 2, self.size[1] / 2, self.size[2]])
        enter, leave = np.full(rays.shape[:-1], -np.inf), np.full(rays.shape[:-1], np.inf)
        with np.errstate(divide="ignore", invalid="ignore"):
            for axis in range(3):
                first, second = ((end[axis] - start[axis]) / direction[..., axis] for end in (low, high))
                np.maximum(enter, np.fmin(first, second), out=enter)
                np.minimum(leave, np.fmax(first, second), out=leave)
        return np.where((enter <= leave) & (enter > 0), enter, np.inf)


@dataclass(frozen=True)
class Bowl:
    """A hemispherical bowl without thickness, its rim horizontal at height `radius`."""

    x: float
    y: float
    radius: float
    color: tuple[int, int, int] = (60, 90, 200)

    def hit(self, origin, rays):
        start = origin - np.array([self.x, self.y, self.radius])
        a, b, c = (rays * rays).sum(-1), (rays * start).sum(-1), start @ start - self.radius**2
        root = np.sqrt(np.maximum(b * b - a * c, 0.0))
        best = np.full(a.shape, np.inf)
        for t in ((-b + root) / a, (-b - root) / a):
            height = start[2] + t * rays[..., 2]
            best = np.where((b * b > a * c) & (t > 0) & (height <= 0.0), np.minimum(best, t), best)
        return best


def camera_above(height=0.6, distance=0.7, pitch_deg=40.0):
    """A camera that looks down along +y of the table by `pitch_deg`."""
    pitch = np.deg2rad(pitch_deg)
    matrix = np.eye(4)
    matrix[:3, :3] = np.stack(
        [[1, 0, 0], [0, -np.sin(pitch), -np.cos(pitch)], [0, np.cos(pitch), -np.sin(pitch)]], axis=1
    )
    matrix[:3, 3] = [0.0, -distance, height]
    return pose_from_matrix(matrix)


def look(
    things,
    camera_to_table=None,
    noise_m=0.0,
    seed=0,
    table_half=(0.6, 0.45),
    floor_z=None,
    wall_y=None,
    scene_id="view",
    camera=CAMERA,
):
    """The observation and the true ids: 0 elsewhere, 1 the table, 2 and on the things."""
    pose = camera_to_table or camera_above()
    v, u = np.indices((camera.height, camera.width), dtype=np.float64)
    local = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1)
    rays = local @ rotation_matrix(pose.quaternion_wxyz).T
    depth, ids = np.full(u.shape, np.inf), np.zeros(u.shape, dtype=np.int32)
    color = np.full((*u.shape, 3), 30, dtype=np.uint8)

    def add(hits, number, tint):
        nearer = hits < depth
        depth[nearer], ids[nearer], color[nearer] = hits[nearer], number, tint

    with np.errstate(divide="ignore", invalid="ignore"):
        for z, half, number, tint in ((0.0, table_half, 1, (180, 150, 120)), (floor_z, (5, 5), 0, (90, 90, 90))):
            if z is not None:
                t = (z - pose.position[2]) / rays[..., 2]
                at = pose.position[:2] + t[..., None] * rays[..., :2]
                add(np.where((t > 0) & (np.abs(at) <= half).all(-1), t, np.inf), number, tint)
        if wall_y is not None:
            add(np.where(rays[..., 1] > 0, (wall_y - pose.position[1]) / rays[..., 1], np.inf), 0, (240, 240, 240))
    for number, thing in enumerate(things, start=2):
        add(thing.hit(pose.position, rays), number, thing.color)
    seen = np.where(np.isfinite(depth) & (depth < 4.5), depth, 0.0)
    noise = np.random.default_rng(seed).normal(0.0, noise_m, seen.shape) if noise_m else 0.0
    return Observation(scene_id, color, np.where(seen > 0, seen + noise, 0.0).astype(np.float32), camera), ids


def overlap(a, b):
    """Intersection over union of two masks."""
    return float((a & b).sum() / max(int((a | b).sum()), 1))


def best_overlaps(truth, found):
    """For each true thing the best intersection over union among the ids found."""
    return [
        max((overlap(truth == t, found == f) for f in np.unique(found[found > 0])), default=0.0)
        for t in np.unique(truth[truth > 1])
    ]
