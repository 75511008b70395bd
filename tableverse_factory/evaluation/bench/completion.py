"""Single-view completion of scanned meshes, by method: volume overlap, Chamfer distance, cavity, CPU time."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool
from scipy import ndimage
from scipy.spatial import ConvexHull, cKDTree

from schemas.config import Config
from schemas.geometry import Camera, Points, TriangleMesh, Vector3
from schemas.identity import make_object_id
from schemas.objects import PerceivedObject, PerceivedObjects, Table
from schemas.observation import Observation
from schemas.outcome import Done
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.open3d_import import o3d
from tableverse_factory.evaluation.bench.measurement import read_meshes
from tableverse_factory.evaluation.bench.solids import make_solids
from tableverse_factory.geometry.math.camera import backproject
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.mesh.surface_samples import sample_surface
from tableverse_factory.geometry.mesh.voxel_solids import VoxelGrid, extract_surface, make_grid
from tableverse_factory.models.services import Services
from tableverse_factory.physics.render.render import look_at, render
from tableverse_factory.stages.place.place import place

VIEWS = ((20.0, 35.0), (140.0, 50.0))  # azimuth and elevation of the two cameras [degrees]
SAMPLES = 10_000
VOXEL_RANGE_M = (0.001, 0.004)
VOXELS = 400_000  # approximate number of points at which a pair of meshes is compared; thin walls need a fine grid
HEIGHT_CELL_M = 0.002
HOLLOW_SHARE = 0.05  # a mesh is hollow if `measure_cavity` finds at least this part of the volume of its hull
OPEN_LAYERS = 40
CAMERA = Camera(600.0, 600.0, 319.5, 239.5, 640, 480)
DISTANCE_M = 0.7
NOISE_M = 0.001
ERROR_PX = 3.0
SIZE_RANGE_M = (0.005, 1.0)  # of what a camera at that distance sees whole, and as more than pixels [m]
TABLE_HALF_M = 1.0


@dataclass(frozen=True, slots=True)
class CompletionScore:
    """Score of one method on one view of a mesh."""

    mesh: str
    view: int  # index into the views
    method: str  # `hull`, `height field`, or the `completion` that the place stage recorded
    iou: float  # volume of the intersection over the union; 0 where nothing was placed
    chamfer_m: float  # mean of the two mean distances between the surfaces [m]
    size_error: float  # mean over the axes of the relative error of the extents
    hollow: bool = False  # whether the true mesh has a cavity that opens upward
    cavity_kept: float = float("nan")  # part of it that stays open; NaN where there is none
    cpu_s: float = 0.0  # CPU time of the place stage; 0 for the other methods [s]


def read_solids(folder: Path | None, most: int | None = None) -> list[tuple[str, TriangleMesh]]:
    """Read named solids of a folder, at most `most`, errors as of `read_meshes`; without one, make `make_solids`."""
    return [*make_solids()] if folder is None else read_meshes(folder, most, _check_size)


def bench_completion(
    meshes: Sequence[tuple[str, TriangleMesh]],
    seed: int = 0,
    views: Sequence[tuple[float, float]] = VIEWS,
    error_m: float = 0.0,
) -> Iterator[list[CompletionScore]]:
    """Yield the scores of each mesh, completed from each view by convex hull, height field and the place stage.

    A view is the azimuth and elevation of a camera [degrees]; `error_m` is that of `render_noisy_view`.
    """
    for index, (name, scan) in enumerate(meshes):
        scores: list[CompletionScore] = []
        truth = stand_on_table(scan)
        share, cavity = measure_cavity(truth)
        hollow = share >= HOLLOW_SHARE
        for view, (azimuth, elevation) in enumerate(views):
            rng = np.random.default_rng([seed, index, view])
            scene = render_noisy_view([truth], np.deg2rad(azimuth), np.deg2rad(elevation), rng, error_m=error_m)
            for method, mesh, cpu_s in _complete_all(scene):
                plain = score_completion(name, view, method, truth, mesh)
                kept = 1.0 - float(contains_points(mesh, cavity).mean()) if hollow else float("nan")
                scores.append(replace(plain, hollow=hollow, cavity_kept=kept, cpu_s=cpu_s))
        yield scores


def _check_size(name: str, mesh: TriangleMesh) -> None:
    size = np.ptp(mesh.vertices, axis=0)
    if size.min() <= 0.0:
        raise InputError(f"{name} is flat: give a solid")
    if not SIZE_RANGE_M[0] <= size.max() <= SIZE_RANGE_M[1]:
        given, (low, high) = " x ".join(f"{side:g}" for side in size), SIZE_RANGE_M
        raise InputError(f"{name} is {given} m: give a solid in metres, {low:g} to {high:g} m along its longest side")


def _complete_all(scene: PerceivedObjects) -> Iterator[tuple[str, TriangleMesh, float]]:
    """Yield the name of each method, its mesh in the table frame, and its CPU time [s]."""
    points = transform_points(scene.camera_to_table, scene.objects[0].points_camera)
    hull = build_hull(points)
    yield "hull", hull, 0.0
    yield "height field", build_height_field(points), 0.0
    start = time.process_time()
    outcome = place(scene, Config(), np.random.default_rng(0), Services(Path()))
    cpu_s = time.process_time() - start
    if isinstance(outcome, Done):
        placed = outcome.value.objects[0]
        yield placed.completion, place_mesh(placed.mesh, placed.pose, placed.scale), cpu_s
    else:
        # An object that is not placed counts in the means: shrunk to a point, it overlaps with nothing.
        middle = points.mean(axis=0)
        yield "carved/nothing", TriangleMesh(middle + 1e-5 * (hull.vertices - middle), hull.faces), cpu_s


def render_noisy_view(
    meshes: Sequence[TriangleMesh],
    azimuth: float,
    elevation: float,
    rng: np.random.Generator,
    noise_m: float = NOISE_M,
    error_m: float = 0.0,
) -> PerceivedObjects:
    """Render meshes (table frame) on a large table with a noisy depth camera; instance ids are 1, 2 and so on.

    `azimuth` is the direction of the camera about z from the middle of the objects, `elevation` that above the horizon
    [rad]; `noise_m` is the standard deviation of the depth, `error_m` that of errors on the objects which agree over a
    few pixels and are smeared over edges, as on gloss, white and black [m].
    """
    every = np.concatenate([mesh.vertices for mesh in meshes])
    target: Vector3 = (every.min(axis=0) + every.max(axis=0)) / 2
    away = np.array([np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)])
    camera_to_table = look_at(target + DISTANCE_M * away, target)
    corners = TABLE_HALF_M * np.array([[-1.0, -1.0, 0.0], [1.0, -1.0, 0.0], [1.0, 1.0, 0.0], [-1.0, 1.0, 0.0]])
    table = TriangleMesh(corners, np.array([[0, 1, 2], [0, 2, 3]], dtype=np.int32))
    seen = render([table, *meshes], CAMERA, camera_to_table, shadows=False)
    noise = rng.normal(0.0, noise_m, seen.depth.shape)
    depth = np.where(seen.depth > 0.0, seen.depth + noise, 0.0)
    if error_m > 0.0:
        error = ndimage.gaussian_filter(rng.standard_normal(depth.shape), ERROR_PX)
        depth = ndimage.uniform_filter(depth + np.where(seen.ids > 0, error_m / error.std() * error, 0.0), 3)
    depth = depth.astype(np.float32)
    ids = np.where(seen.ids == 0, -1, np.maximum(seen.ids, 0)).astype(np.int32)
    points = backproject(depth, CAMERA)
    objects = tuple(
        PerceivedObject(make_object_id(k), k + 1, "object", 1.0, points[ids == k + 1], seen.color[ids == k + 1])
        for k in range(len(meshes))
    )
    plane = Table(np.zeros(2), np.full(2, TABLE_HALF_M), 0.0, (128, 128, 128), noise_m)
    observation = Observation("view", seen.color, depth, CAMERA)
    return PerceivedObjects("view", observation, camera_to_table, plane, ids, objects, "view")


def stand_on_table(mesh: TriangleMesh) -> TriangleMesh:
    """Move the middle of the mesh's footprint to the origin and its lowest point onto the table."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    origin = np.array([*(low + high)[:2] / 2, low[2]])
    return TriangleMesh(mesh.vertices - origin, mesh.faces)


def build_hull(points: Points) -> TriangleMesh:
    """Build the convex hull, faces turned outward."""
    hull = ConvexHull(points)
    corners = points[hull.simplices]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    inward = np.einsum("ij,ij->i", normal, hull.equations[:, :3]) < 0.0
    faces = np.where(inward[:, None], hull.simplices[:, ::-1], hull.simplices)
    return TriangleMesh(points, faces.astype(np.int32))


def build_height_field(points: Points) -> TriangleMesh:
    """Build the solid between the points and the table, the simplest completion that uses the table."""
    low, high = points.min(axis=0), points.max(axis=0)
    top = max(float(high[2]), 2 * HEIGHT_CELL_M)
    cell = HEIGHT_CELL_M
    grid = make_grid(np.array([low[0], low[1], 0.0]) - cell, np.array([high[0], high[1], top]) + cell, cell)
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
    return extract_surface(np.minimum(np.minimum(heights[:, :, None] - z, z), footprint[:, :, None]), grid)


def measure_cavity(mesh: TriangleMesh) -> tuple[float, Points]:
    """Measure the space that water poured from above would fill: cells of the hull, walled in at their height.

    Return its volume over that of the hull, and its samples, shape (n, 3) [m].
    """
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    grid = make_grid(low, high, float((high - low).max()) / (2 * OPEN_LAYERS))
    points = grid.points()
    solid = contains_points(mesh, points).reshape(grid.shape)
    hull = contains_points(build_hull(mesh.vertices), points).reshape(grid.shape)
    held = _find_cavity_cells(solid, grid) & hull
    return float(held.sum() / max(int(hull.sum()), 1)), points[held.ravel()]


def _find_cavity_cells(solid: Bool[np.ndarray, "nx ny nz"], grid: VoxelGrid) -> Bool[np.ndarray, "nx ny nz"]:
    """Find cells that are open from above, have a floor below and, in their layer, no way to the outside."""
    # Walls thinner than a cell would leak.
    walls = ndimage.binary_dilation(solid, ndimage.generate_binary_structure(3, 1))
    floored = np.logical_or.accumulate(walls, axis=2)
    covered = np.flip(np.logical_or.accumulate(np.flip(solid, axis=2), axis=2), axis=2)
    held = np.zeros(grid.shape, dtype=bool)
    for k in range(grid.shape[2]):
        held[:, :, k] = ndimage.binary_fill_holes(walls[:, :, k]) & ~covered[:, :, k]
    return np.asarray(held & floored & ~walls)


def score_completion(name: str, view: int, method: str, truth: TriangleMesh, ours: TriangleMesh) -> CompletionScore:
    """Compare two meshes in the table frame."""
    used = ours.vertices[np.unique(ours.faces)]
    low = np.minimum(truth.vertices.min(axis=0), used.min(axis=0))
    high = np.maximum(truth.vertices.max(axis=0), used.max(axis=0))
    cell = float(np.clip(np.cbrt((high - low).prod() / VOXELS), *VOXEL_RANGE_M))
    axes = [np.arange(low[k] + cell / 2, high[k], cell) for k in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    a, b = contains_points(truth, points), contains_points(ours, points)
    union = int((a | b).sum())
    iou = float((a & b).sum() / union) if union else 0.0
    one, two = sample_surface(truth, SAMPLES)[0], sample_surface(ours, SAMPLES)[0]
    there, back = np.mean(cKDTree(two).query(one)[0]), np.mean(cKDTree(one).query(two)[0])
    true_size, size = np.ptp(truth.vertices, axis=0), np.ptp(used, axis=0)
    return CompletionScore(
        name, view, method, iou, float(there + back) / 2, float(np.mean(np.abs(size / true_size - 1.0)))
    )


def contains_points(mesh: TriangleMesh, points: Points) -> Bool[np.ndarray, " n"]:
    """Test which points lie inside, by the majority of three rays, so that small holes do no harm."""
    scene = o3d.t.geometry.RaycastingScene(nthreads=1)
    tensor = o3d.core.Tensor.from_numpy
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.faces.astype(np.uint32)))
    inside = scene.compute_occupancy(tensor(points.astype(np.float32)), nthreads=1, nsamples=3)
    return np.asarray(inside.numpy() > 0.5)
