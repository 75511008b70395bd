"""How well single-view completion recovers scanned meshes: volume overlap and Chamfer distance, by method."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
from jaxtyping import Bool
from scipy.spatial import ConvexHull, cKDTree

from schemas.config import Config
from schemas.geometry import Camera, Points, TriangleMesh
from schemas.objects import PerceivedObject, PerceivedObjects, Table
from schemas.observation import Observation
from schemas.outcome import Done
from tableverse_factory.geometry.camera import backproject
from tableverse_factory.geometry.meshes import placed_mesh, read_mesh
from tableverse_factory.geometry.samples import surface_samples
from tableverse_factory.geometry.transforms import transform_points
from tableverse_factory.physics.render import look_at, render
from tableverse_factory.place.place import place
from tableverse_factory.services import Services

CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
VIEWS = ((20.0, 35.0), (140.0, 50.0))
"""Azimuth and elevation of the two cameras [degrees]."""
DISTANCE_M = 0.7
NOISE_M = 0.001
SAMPLES = 10_000
VOXELS_ON_LONGEST_SIDE = 72


@dataclass(frozen=True, slots=True)
class Score:
    """One mesh, one view, one method.

    Attributes:
        iou: Volume of the intersection over the union.
        chamfer_m: Mean of the two mean distances between the surfaces [m].
        size_error: Mean over the axes of the relative error of the extents.
        method: Name of the method; the `completion` that was recorded for ours.
    """

    mesh: str
    view: int
    method: str
    iou: float
    chamfer_m: float
    size_error: float


def bench_completion(folder: Path, seed: int = 0) -> list[Score]:
    """Completes every mesh in `folder` from two views, beside the convex hull and the height field."""
    scores: list[Score] = []
    for path in sorted(folder.glob("*.obj")):
        truth = standing(read_mesh(path.read_bytes(), path.name))
        for view in range(len(VIEWS)):
            scene = seen_alone(truth, view, np.random.default_rng([seed, view, len(scores)]))
            points = transform_points(scene.camera_to_table, scene.objects[0].points_camera)
            hull = hull_of(points)
            scores.append(score(path.stem, view, "hull", truth, hull))
            outcome = place(scene, Config(), np.random.default_rng(0), Services(Path()))
            if isinstance(outcome, Done):
                item = outcome.value.objects[0]
                ours = placed_mesh(item.mesh, item.pose, item.scale)
                scores.append(score(path.stem, view, item.completion, truth, ours))
    return scores


def standing(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh with the middle of its footprint at the origin and its lowest point on the table."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    origin = np.array([*(low + high)[:2] / 2, low[2]])
    return TriangleMesh(mesh.vertices - origin, mesh.faces)


def seen_alone(mesh: TriangleMesh, view: int, rng: np.random.Generator) -> PerceivedObjects:
    """One object on a large table, as a noisy depth camera sees it, with its true mask."""
    azimuth, elevation = np.deg2rad(VIEWS[view])
    target = np.array([0.0, 0.0, mesh.vertices[:, 2].max() / 2])
    away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    camera_to_table = look_at(target + DISTANCE_M * away, target)
    side = 1.0
    corners = np.array([[-side, -side, 0.0], [side, -side, 0.0], [side, side, 0.0], [-side, side, 0.0]])
    table = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))
    seen = render([table, mesh], CAMERA, camera_to_table, shadows=False)
    noise = rng.normal(0.0, NOISE_M, seen.depth.shape)
    depth = np.where(seen.depth > 0.0, seen.depth + noise, 0.0).astype(np.float32)
    own = seen.ids == 1
    ids = np.where(own, 1, np.where(seen.ids == 0, -1, 0)).astype(np.int32)
    observation = Observation("bench", seen.color, depth, CAMERA)
    points = backproject(depth, CAMERA)[own]
    item = PerceivedObject("obj_000", 1, "object", 1.0, points, seen.color[own])
    plane = Table(np.zeros(2), np.array([side, side]), 0.0, (128, 128, 128), NOISE_M)
    return PerceivedObjects("bench", observation, camera_to_table, plane, ids, (item,), "bench")


def hull_of(points: Points) -> TriangleMesh:
    """The convex hull, faces turned outward."""
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normal, hull.equations[:, :3]) < 0.0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    return TriangleMesh(points, faces.astype(np.int32))


def score(name: str, view: int, method: str, truth: TriangleMesh, ours: TriangleMesh) -> Score:
    """Compares two meshes in the table frame."""
    used = ours.vertices[np.unique(ours.faces)]
    low = np.minimum(truth.vertices.min(axis=0), used.min(axis=0))
    high = np.maximum(truth.vertices.max(axis=0), used.max(axis=0))
    cell = (high - low).max() / VOXELS_ON_LONGEST_SIDE
    axes = [np.arange(low[k] + cell / 2, high[k], cell) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    a, b = inside_of(truth, points), inside_of(ours, points)
    union = int((a | b).sum())
    iou = float((a & b).sum() / union) if union else 0.0
    one, two = surface_samples(truth, SAMPLES)[0], surface_samples(ours, SAMPLES)[0]
    there, back = np.mean(cKDTree(two).query(one)[0]), np.mean(cKDTree(one).query(two)[0])
    true_size, size = np.ptp(truth.vertices, axis=0), np.ptp(used, axis=0)
    return Score(name, view, method, iou, float(there + back) / 2, float(np.mean(np.abs(size / true_size - 1.0))))


def inside_of(mesh: TriangleMesh, points: Points) -> Bool[np.ndarray, " n"]:
    """Whether each point lies inside, by the majority of three rays, so that small holes do no harm."""
    scene = o3d.t.geometry.RaycastingScene()
    vertices, faces = (
        o3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32)),
        o3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)),
    )
    scene.add_triangles(vertices, faces)
    inside = scene.compute_occupancy(o3d.core.Tensor.from_numpy(points.astype(np.float32)), nthreads=1, nsamples=3)
    return np.asarray(inside.numpy() > 0.5)
