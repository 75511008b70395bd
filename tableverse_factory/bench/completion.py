"""How well single-view completion recovers scanned meshes: volume overlap and Chamfer distance, by method."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import open3d as o3d
from jaxtyping import Bool
from scipy.spatial import ConvexHull, cKDTree

from schemas.config import Config
from schemas.geometry import Points, TriangleMesh
from schemas.objects import PerceivedObjects
from schemas.outcome import Done
from tableverse_factory.bench.views import seen_on_table
from tableverse_factory.geometry.meshes import placed_mesh, read_mesh
from tableverse_factory.geometry.samples import surface_samples
from tableverse_factory.geometry.transforms import transform_points
from tableverse_factory.place.carved import columns
from tableverse_factory.place.place import place
from tableverse_factory.place.sighting import sight
from tableverse_factory.place.support import find_supports
from tableverse_factory.services import Services

VIEWS = ((20.0, 35.0), (140.0, 50.0))
"""Azimuth and elevation of the two cameras [degrees]."""
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
    """Completes every mesh in `folder` from two views, with the convex hull and the height field beside ours."""
    scores: list[Score] = []
    for index, path in enumerate(sorted(folder.glob("*.obj"))):
        truth = standing(read_mesh(path.read_bytes(), path.name))
        for view, (azimuth, elevation) in enumerate(VIEWS):
            rng = np.random.default_rng([seed, index, view])
            scene = seen_on_table([truth], np.deg2rad(azimuth), np.deg2rad(elevation), rng)
            for method, mesh in _completions(scene):
                scores.append(score(path.stem, view, method, truth, mesh))
    return scores


def _completions(scene: PerceivedObjects) -> Iterator[tuple[str, TriangleMesh]]:
    """The methods and their meshes in the table frame."""
    item = scene.objects[0]
    yield "hull", hull_of(transform_points(scene.camera_to_table, item.points_camera))
    mesh, pose = columns(sight(scene, item, find_supports(scene)[item.object_id]))
    yield "height field", placed_mesh(mesh, pose)
    outcome = place(scene, Config(), np.random.default_rng(0), Services(Path()))
    if isinstance(outcome, Done):
        placed = outcome.value.objects[0]
        yield placed.completion, placed_mesh(placed.mesh, placed.pose, placed.scale)


def standing(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh with the middle of its footprint at the origin and its lowest point on the table."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    origin = np.array([*(low + high)[:2] / 2, low[2]])
    return TriangleMesh(mesh.vertices - origin, mesh.faces)


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
