"""Removal of overlaps between completed objects, where the hidden parts of both were guessed into one space.

Rectification would push such objects apart, though their visible sides are where the picture shows them.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
from jaxtyping import Float64
from manifold3d import Manifold
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, QhullError

from schemas.geometry import Points, Pose, TriangleMesh
from schemas.objects import PerceivedObject, PerceivedObjects
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.geometry.mesh.voxel_solids import find_largest_part, from_manifold, to_manifold
from tableverse_factory.stages.place.completion.ray_misfit import compute_mesh_misfit, sample_rays
from tableverse_factory.stages.place.interfaces import Completion
from tableverse_factory.stages.place.view.object_view import ObjectView

# Kinds that follow the picture freely and may lose a part, the freest last; the others keep their shape.
FREE = ("carved/half_turn", "carved/columns", "carved/inflation")
LEAST_DEPTH_M = 0.001  # mean thickness from which an overlap is removed [m]
MIN_LEFT = 0.4  # least share of a solid's volume that has to be left
MAX_WORSE_M = 2e-4  # most by which a cut may worsen the agreement with the picture [m]
MARGIN_M = 0.003  # wanted distance of what is seen from the plane between two objects [m]


def remove_overlaps(
    scene: PerceivedObjects, views: Sequence[ObjectView], answers: Sequence[Completion | GeometryError]
) -> list[Completion | GeometryError]:
    """Cut free shapes where they reach into their neighbours: by an upright plane, else by the neighbour itself.

    A shape stays whole where the cut would take what the picture shows, and contents and what stands on others stay.
    """
    found: dict[int, Completion] = {}
    solids: dict[int, Manifold] = {}
    for index, answer in enumerate(answers):
        if isinstance(answer, Completion) and answer.pose is not None:
            found[index], solids[index] = answer, _place(answer.mesh, answer.pose)

    def try_cut(index: int, rest: Manifold) -> None:
        cut = _replace(views[index], found[index], solids[index], rest)
        if cut is not None:
            found[index], solids[index] = cut

    for pair in _list_neighbours(scene, views, sorted(solids)):
        free = [index for index in pair if found[index].method in FREE]
        if not free or not _do_overlap(*(solids[index] for index in pair)):
            continue
        sides = [views[index].points if index in free else from_manifold(solids[index]).vertices for index in pair]
        if (plane := find_upright_plane(*sides)) is not None:
            normal, offset = plane
            for index in free:
                sign = 1.0 if index == pair[0] else -1.0
                try_cut(index, solids[index].trim_by_plane(tuple(sign * normal), sign * offset))
        for index in sorted(free, key=lambda index: -FREE.index(found[index].method)):
            other = pair[index == pair[0]]
            if _do_overlap(solids[index], solids[other]):
                try_cut(index, solids[index] - solids[other])
    return [found.get(index, answer) for index, answer in enumerate(answers)]


def find_upright_plane(one: Points, other: Points) -> tuple[Float64[np.ndarray, "3"], float] | None:
    """Find the upright plane that parts two clouds best: a unit normal towards `one`, and its offset [m].

    Points that are nearer than `MARGIN_M`, or beyond it, cost their distance (a support vector machine). None if a
    cloud is flat.
    """
    try:
        clouds = [cloud[ConvexHull(cloud).vertices] for cloud in (one, other)]
    except (QhullError, ValueError):
        return None
    middle = (clouds[0].mean(axis=0) + clouds[1].mean(axis=0)) / 2
    counts = [len(cloud) for cloud in clouds]
    total = sum(counts)
    signs = np.repeat([1.0, -1.0], counts)
    across = signs[:, None] * (np.concatenate(clouds) - middle)[:, :2]
    answer = linprog(  # normal x and y, offset, and what each point lacks
        np.concatenate([np.zeros(3), np.repeat(1.0 / np.array(counts), counts)]),
        A_ub=-np.concatenate([across, -signs[:, None], np.eye(total)], axis=1),
        b_ub=np.full(total, -MARGIN_M),
        bounds=[(-1.0, 1.0)] * 2 + [(None, None)] + [(0.0, None)] * total,
    )
    length = float(np.linalg.norm(answer.x[:2])) if answer.status == 0 else 0.0
    if length < 1e-6:
        return None
    normal = np.array([*answer.x[:2], 0.0]) / length
    return normal, float(normal @ middle + answer.x[2] / length)


def _list_neighbours(
    scene: PerceivedObjects, views: Sequence[ObjectView], indices: Sequence[int]
) -> Iterator[tuple[int, int]]:
    """List the pairs of objects of which neither stands on the other or in it."""
    of_instance = {item.instance_id: item for item in scene.objects}
    items = [of_instance[view.instance_id] for view in views]

    def depends(item: PerceivedObject, view: ObjectView, other: PerceivedObject) -> bool:
        return other.object_id in (view.support.carrier, item.contained_in)

    for i, j in combinations(indices, 2):
        if not depends(items[i], views[i], items[j]) and not depends(items[j], views[j], items[i]):
            yield i, j


def _do_overlap(one: Manifold, other: Manifold) -> bool:
    common = one ^ other
    return not common.is_empty() and 2 * common.volume() >= LEAST_DEPTH_M * common.surface_area()


def _place(mesh: TriangleMesh, pose: Pose) -> Manifold:
    return to_manifold(TriangleMesh(transform_points(pose, mesh.vertices), mesh.faces))


def _replace(
    view: ObjectView, completion: Completion, own: Manifold, rest: Manifold
) -> tuple[Completion, Manifold] | None:
    """Make a completion of what is left of its solid; None if that is too little, or does not look the same."""
    if rest.is_empty() or completion.pose is None:
        return None
    rest = find_largest_part(rest)
    if rest.volume() < MIN_LEFT * own.volume():
        return None
    placed = from_manifold(rest)
    mesh = TriangleMesh(transform_points(invert_pose(completion.pose), placed.vertices), placed.faces)
    rays = sample_rays(view)
    before = compute_mesh_misfit(rays, completion.mesh, completion.pose)
    if compute_mesh_misfit(rays, mesh, completion.pose) > before + MAX_WORSE_M:
        return None
    return replace(completion, mesh=mesh), rest
