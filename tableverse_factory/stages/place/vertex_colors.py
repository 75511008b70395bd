"""Vertex colours from the picture: observed where visible, from similar points elsewhere."""

import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial import cKDTree

from schemas.geometry import Colors, Points, Pose, TriangleMesh
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.transforms import invert_pose, rotation_matrix, transform_points
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.mesh.occluding_edges import find_behind_edges
from tableverse_factory.geometry.mesh.raycasting import RaycastingScene, make_raycasting_scene, pack_rays
from tableverse_factory.stages.place.view.object_view import Distances, ObjectView

NEIGHBOURS = 5
SOURCES = 8000
LEAF_SIZE = 64  # points in a leaf of the tree: in so many dimensions half the time of the default
NORMAL_M = 0.03  # half the extra distance of a surface that faces the opposite way [m]
LEAST_SHARE = 0.2  # of the points that must show the mesh, and not behind an edge
COPY_M = 0.008  # extra distance of a colour borrowed from the opposite side [m]
INSIDE_M = 0.12  # extra distance between the inside of a vessel and its outside, which may have another colour [m]
OFFSET_M = 0.002  # from a surface to where its surroundings are looked for [m]
LEAST_MET = 7  # of the level directions, in which a vessel surrounds what is inside: one may be a chip or a spout
_ANGLES = np.arange(8) * np.pi / 4
_LEVEL = np.stack([np.cos(_ANGLES), np.sin(_ANGLES), np.zeros(8)], axis=1)
_UP = np.array([0.0, 0.0, 1.0])
# Identity, half a turn about the vertical, and reflections in the two upright planes of the object's own frame.
_TURNS = np.array([[1.0, 1.0, 1.0], [-1.0, -1.0, 1.0], [-1.0, 1.0, 1.0], [1.0, -1.0, 1.0]])


def paint_vertices(mesh: TriangleMesh, pose: Pose, view: ObjectView, *, projected: bool) -> TriangleMesh:
    """Paint each vertex with the colours of the observed points nearest in position and direction.

    `projected` takes the points to where their rays meet the mesh, which their depth misses.

    The points also count turned by half and mirrored in the object's own upright frame, a little farther away: so the
    back looks like the front. The inside of a vessel takes its colours from its inside, where any of it was seen.
    """
    seen, towards, shown = _project_sources(mesh, pose, view) if projected else (view.points, view.normals, view.colors)
    step = max(1, len(seen) // SOURCES)
    upright = Pose(pose.position, _extract_heading(pose))
    to_own = invert_pose(upright)
    turn = rotation_matrix(to_own.quaternion_wxyz)
    points = transform_points(to_own, seen[::step])
    normals = towards[::step] @ turn.T
    rotation = turn @ rotation_matrix(pose.quaternion_wxyz)
    vertices = mesh.vertices @ rotation.T
    own = TriangleMesh(vertices, mesh.faces)
    scene, faced = make_raycasting_scene(own), _compute_area_vectors(own)
    inside, outward = _measure_inside(scene, points, normals), _compute_vertex_normals(own, faced)
    sources = np.concatenate(
        [_stack_features(points * t, normals * t, inside, 0.0 if k == 0 else COPY_M) for k, t in enumerate(_TURNS)]
    )
    targets = _stack_features(vertices, outward, _measure_inside_of_vertices(scene, own, faced, outward), 0.0)
    colors = _mix_colors(sources, np.tile(shown[::step], (len(_TURNS), 1)), targets)
    return TriangleMesh(mesh.vertices, mesh.faces, colors)


def _project_sources(mesh: TriangleMesh, pose: Pose, view: ObjectView) -> tuple[Points, Points, Colors]:
    """Find points, normals and colours where the picture shows the mesh; as observed where it shows too little of it.

    A shape that misses the depth misses the edges in the picture a little too: just behind them it shows no colour.
    """
    scene = make_raycasting_scene(place_mesh(mesh, pose))
    rays = view.points - view.eye
    hit = scene.cast_rays(pack_rays(view.eye, rays), nthreads=1)
    share, normals = (hit[key].numpy().astype(np.float64) for key in ("t_hit", "primitive_normals"))
    behind = find_behind_edges(scene, view.camera, view.camera_to_table, view.own)
    pixels = np.rint(project(transform_points(invert_pose(view.camera_to_table), view.points), view.camera))
    column, row = np.clip(pixels.astype(int), 0, np.array(behind.shape[::-1]) - 1).T
    kept = np.isfinite(share) & ~behind[row, column]
    if kept.sum() < LEAST_SHARE * len(kept):
        return view.points, view.normals, view.colors
    return view.eye + rays[kept] * share[kept, None], normals[kept], view.colors[kept]


def _compute_area_vectors(mesh: TriangleMesh) -> Points:
    """Compute the normals of the faces, as long as twice their areas [m^2]."""
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return np.cross(b - a, c - a)


def _compute_vertex_normals(mesh: TriangleMesh, faced: Points) -> Points:
    """Compute the mean normals of adjacent faces by area, unit length; zero where a vertex has none."""
    normals = np.zeros_like(mesh.vertices)
    for k in range(3):
        np.add.at(normals, mesh.faces[:, k], faced)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return normals / np.where(length > 0.0, length, 1.0)


def _extract_heading(pose: Pose) -> Float64[np.ndarray, "4"]:
    w, z = pose.quaternion_wxyz[0], pose.quaternion_wxyz[3]
    length = float(np.hypot(w, z))
    return np.array([w, 0.0, 0.0, z]) / length if length > 1e-6 else np.array([1.0, 0.0, 0.0, 0.0])


def _measure_inside(scene: RaycastingScene, points: Points, normals: Points) -> Distances:
    """Measure how far inside a vessel points count [m]: `INSIDE_M` in it, half at its rim, 0 outside; z is up."""
    before = points + OFFSET_M * normals
    inside = _find_surrounded(scene, before)
    rim = ~inside & _find_surrounded(scene, before - 2 * OFFSET_M * _UP)
    return INSIDE_M * inside + INSIDE_M / 2 * rim


def _measure_inside_of_vertices(
    scene: RaycastingScene, mesh: TriangleMesh, faced: Points, normals: Points
) -> Distances:
    """Measure the same of vertices, by most of the area beside each: the normal at a corner may end in a wall."""
    area = np.maximum(np.linalg.norm(faced, axis=1), 1e-18)
    surrounded = _find_surrounded(scene, mesh.vertices[mesh.faces].mean(axis=1) + OFFSET_M * faced / area[:, None])
    at, count = mesh.faces.ravel(), len(mesh.vertices)
    total, within = (np.bincount(at, np.repeat(weight, 3), count) for weight in (area, area * surrounded))
    return np.where(within > 0.5 * total, INSIDE_M, _measure_inside(scene, mesh.vertices, normals))


def _find_surrounded(scene: RaycastingScene, points: Points) -> Bool[np.ndarray, " n"]:
    """Find the points that a mesh surrounds to the sides and not above."""
    rays = pack_rays(points[:, None], np.vstack([_LEVEL, _UP]))
    met = scene.test_occlusions(rays, nthreads=1).numpy()
    return np.asarray((met[:, :-1].sum(axis=1) >= LEAST_MET) & ~met[:, -1])


def _stack_features(points: Points, normals: Points, inside: Distances, offset: float) -> Float64[np.ndarray, "n 8"]:
    return np.column_stack([points, NORMAL_M * normals, inside, np.full(len(points), offset)])


def _mix_colors(sources: Float64[np.ndarray, "n 8"], colors: Colors, targets: Float64[np.ndarray, "m 8"]) -> Colors:
    count = min(NEIGHBOURS, len(sources))
    distance, index = cKDTree(sources, LEAF_SIZE).query(targets, k=count)
    distance, index = np.reshape(distance, (-1, count)), np.reshape(index, (-1, count))
    weight = 1.0 / (distance**2 + 1e-6)
    weight /= weight.sum(axis=1, keepdims=True)
    mixed = (weight[:, :, None] * colors[index].astype(np.float64)).sum(axis=1)
    return np.ascontiguousarray(np.rint(mixed).astype(np.uint8))
