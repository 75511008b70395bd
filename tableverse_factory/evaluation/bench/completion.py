"""How well single-view completion recovers scanned meshes: volume overlap and Chamfer distance, by method."""

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import open3d as o3d
from jaxtyping import Bool
from scipy import ndimage
from scipy.spatial import ConvexHull, cKDTree

from schemas.config import Config
from schemas.geometry import Points, TriangleMesh
from schemas.objects import PerceivedObjects
from schemas.outcome import Done
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.evaluation.bench.views import seen_on_table
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.mesh.meshes import placed_mesh, read_mesh
from tableverse_factory.geometry.mesh.surface_samples import surface_samples
from tableverse_factory.geometry.mesh.voxel_solids import VoxelGrid, grid_over, solid_surface
from tableverse_factory.models.services import Services
from tableverse_factory.stages.place.place import place

VIEWS = ((20.0, 35.0), (140.0, 50.0))
"""Azimuth and elevation of the two cameras [degrees]."""
SAMPLES = 10_000
VOXEL_RANGE_M = (0.001, 0.004)
VOXELS = 400_000
"""About so many points are asked for each pair of meshes, at most: walls of a millimetre need a fine grid."""
HEIGHT_CELL_M = 0.002
HOLLOW_SHARE = 0.05
"""A mesh is hollow if a cavity that opens upward and has a floor takes at least this part of its hull's volume."""
OPEN_LAYERS = 40


@dataclass(frozen=True, slots=True)
class CompletionScore:
    """One mesh, one view, one method.

    Attributes:
        mesh: Name of the mesh.
        view: Which of `VIEWS`.
        method: Name of the method; the `completion` that was recorded for ours.
        iou: Volume of the intersection over the union; 0 where nothing was placed.
        chamfer_m: Mean of the two mean distances between the surfaces [m].
        size_error: Mean over the axes of the relative error of the extents.
        hollow: Whether the true mesh has a cavity that opens upward.
        cavity_kept: Part of that cavity that the completed mesh leaves open; NaN where there is none.
        cpu_s: What sighting and completion took; 0 for the methods beside ours.
    """

    mesh: str
    view: int
    method: str
    iou: float
    chamfer_m: float
    size_error: float
    hollow: bool = False
    cavity_kept: float = float("nan")
    cpu_s: float = 0.0


@dataclass(frozen=True, slots=True)
class CavityScore:
    """The space within a mesh's hull that is open from above.

    Attributes:
        share: Its volume over the hull's.
        points: Samples of it. Shape (n, 3) [m].
    """

    share: float
    points: Points


def bench_completion(folder: Path, seed: int = 0) -> list[CompletionScore]:
    """Completes every mesh in `folder` from two views, with the convex hull and the height field beside ours.

    Raises:
        InputError: if there is no mesh.
    """
    paths = sorted(folder.glob("*.obj"))
    if not paths:
        raise InputError(f"{sanitize_line(str(folder))} holds no meshes: give a folder with *.obj in it")
    scores: list[CompletionScore] = []
    for index, path in enumerate(paths):
        truth = standing(read_mesh(path.read_bytes(), path.name))
        cavity = cavity_of(truth)
        for view, (azimuth, elevation) in enumerate(VIEWS):
            rng = np.random.default_rng([seed, index, view])
            scene = seen_on_table([truth], np.deg2rad(azimuth), np.deg2rad(elevation), rng)
            for method, mesh, cpu_s in _completions(scene):
                scores.append(_measured(score(path.stem, view, method, truth, mesh), cavity, mesh, cpu_s))
    return scores


def _measured(plain: CompletionScore, cavity: CavityScore, mesh: TriangleMesh, cpu_s: float) -> CompletionScore:
    hollow = cavity.share >= HOLLOW_SHARE
    kept = 1.0 - float(inside_of(mesh, cavity.points).mean()) if hollow else float("nan")
    return replace(plain, hollow=hollow, cavity_kept=kept, cpu_s=cpu_s)


def _completions(scene: PerceivedObjects) -> Iterator[tuple[str, TriangleMesh, float]]:
    """The methods, their meshes in the table frame, and the CPU seconds of ours."""
    points = transform_points(scene.camera_to_table, scene.objects[0].points_camera)
    hull = hull_of(points)
    yield "hull", hull, 0.0
    yield "height field", height_field_of(points), 0.0
    start = time.process_time()
    outcome = place(scene, Config(), np.random.default_rng(0), Services(Path()))
    cpu_s = time.process_time() - start
    if isinstance(outcome, Done):
        placed = outcome.value.objects[0]
        yield placed.completion, placed_mesh(placed.mesh, placed.pose, placed.scale), cpu_s
    else:
        # What is not placed stays in the means: as a point it overlaps with nothing.
        middle = points.mean(axis=0)
        yield "carved/nothing", TriangleMesh(middle + 1e-5 * (hull.vertices - middle), hull.faces), cpu_s


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


def height_field_of(points: Points) -> TriangleMesh:
    """All below the points down to the table: the plainest completion with the table in it."""
    low, high = points.min(axis=0), points.max(axis=0)
    top = max(float(high[2]), 2 * HEIGHT_CELL_M)
    corner = HEIGHT_CELL_M
    grid = grid_over(
        np.array([low[0], low[1], 0.0]) - corner, np.array([high[0], high[1], top]) + corner, HEIGHT_CELL_M
    )
    index = np.clip(np.rint((points[:, :2] - grid.origin[:2]) / grid.cell).astype(int), 0, np.array(grid.shape[:2]) - 1)
    heights = np.full(grid.shape[:2], -np.inf)
    np.maximum.at(heights, (index[:, 0], index[:, 1]), points[:, 2])
    seen = np.isfinite(heights)
    closed = seen | ndimage.binary_closing(np.pad(seen, 3), iterations=2)[3:-3, 3:-3]
    nearest = ndimage.distance_transform_edt(~seen, return_distances=False, return_indices=True)
    heights = np.maximum(heights[nearest[0], nearest[1]], HEIGHT_CELL_M)
    inside = ndimage.distance_transform_edt(np.pad(closed, 1))[1:-1, 1:-1] - 0.5
    outside = ndimage.distance_transform_edt(~closed) - 0.5
    footprint = np.where(closed, inside, -outside) * grid.cell
    z = grid.axes()[2]
    return solid_surface(np.minimum(np.minimum(heights[:, :, None] - z, z), footprint[:, :, None]), grid)


def cavity_of(mesh: TriangleMesh) -> CavityScore:
    """What water poured from above would fill: cells of the hull, outside of the mesh, walled in at their height."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    grid = grid_over(low, high, float((high - low).max()) / (2 * OPEN_LAYERS))
    points = grid.points()
    solid = inside_of(mesh, points).reshape(grid.shape)
    hull = inside_of(hull_of(mesh.vertices), points).reshape(grid.shape)
    held = _held(solid, grid)
    return CavityScore(float((held & hull).sum() / max(int(hull.sum()), 1)), points[(held & hull).ravel()])


def _held(solid: Bool[np.ndarray, "nx ny nz"], grid: VoxelGrid) -> Bool[np.ndarray, "nx ny nz"]:
    """Cells open from above, with a floor below them and, within their layer, not joined with the outside."""
    # Walls thinner than a cell would leak.
    walls = ndimage.binary_dilation(solid, ndimage.generate_binary_structure(3, 1))
    floored = np.logical_or.accumulate(walls, axis=2)
    covered = np.flip(np.logical_or.accumulate(np.flip(solid, axis=2), axis=2), axis=2)
    held = np.zeros(grid.shape, dtype=bool)
    for k in range(grid.shape[2]):
        held[:, :, k] = ndimage.binary_fill_holes(walls[:, :, k]) & ~covered[:, :, k]
    return np.asarray(held & floored & ~walls)


def score(name: str, view: int, method: str, truth: TriangleMesh, ours: TriangleMesh) -> CompletionScore:
    """Compares two meshes in the table frame."""
    used = ours.vertices[np.unique(ours.faces)]
    low = np.minimum(truth.vertices.min(axis=0), used.min(axis=0))
    high = np.maximum(truth.vertices.max(axis=0), used.max(axis=0))
    cell = float(np.clip(np.cbrt((high - low).prod() / VOXELS), *VOXEL_RANGE_M))
    axes = [np.arange(low[k] + cell / 2, high[k], cell) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    a, b = inside_of(truth, points), inside_of(ours, points)
    union = int((a | b).sum())
    iou = float((a & b).sum() / union) if union else 0.0
    one, two = surface_samples(truth, SAMPLES)[0], surface_samples(ours, SAMPLES)[0]
    there, back = np.mean(cKDTree(two).query(one)[0]), np.mean(cKDTree(one).query(two)[0])
    true_size, size = np.ptp(truth.vertices, axis=0), np.ptp(used, axis=0)
    return CompletionScore(
        name, view, method, iou, float(there + back) / 2, float(np.mean(np.abs(size / true_size - 1.0)))
    )


def inside_of(mesh: TriangleMesh, points: Points) -> Bool[np.ndarray, " n"]:
    """Whether each point lies inside, by the majority of three rays, so that small holes do no harm."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    vertices, faces = (
        o3d.core.Tensor.from_numpy(mesh.vertices.astype(np.float32)),
        o3d.core.Tensor.from_numpy(mesh.faces.astype(np.uint32)),
    )
    scene.add_triangles(vertices, faces)
    inside = scene.compute_occupancy(o3d.core.Tensor.from_numpy(points.astype(np.float32)), nthreads=1, nsamples=3)
    return np.asarray(inside.numpy() > 0.5)
