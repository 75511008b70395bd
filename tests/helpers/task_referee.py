"""A second, independent reading of the tasks' hard constraints, on surface samples and plain numpy.

It shares no code with the product and is coarser: it calls a fault only what is clearly one.
"""

import re

import numpy as np
import trimesh
from trimesh.intersections import mesh_plane

RELATIONS = "on|into|inside|in|next to|to the left of|to the right of|behind|in front of|outside"
TEMPLATE = re.compile(rf"Pick up (the .+) and place it ({RELATIONS}) (the .+)")
GRIPPER_M = 0.078


def faults(tasks, meshes: dict[str, trimesh.Trimesh]) -> list[str]:
    found = []
    triples = [(t.x_id, t.relation, t.y_id) for t in tasks]
    if len(set(triples)) != len(triples):
        found.append("a triple repeats")
    for task in tasks:
        match = TEMPLATE.fullmatch(task.instruction)
        if match is None or match[2] != task.relation:
            found.append(f"template: {task.instruction}")
        elif task.x_id not in meshes or task.y_id not in meshes or task.x_id == task.y_id:
            found.append(f"ids: {task}")
        else:
            found += [f"{task.instruction}: {f}" for f in _faults(task.relation, meshes[task.x_id], meshes[task.y_id])]
    return found


def _faults(relation: str, x: trimesh.Trimesh, y: trimesh.Trimesh) -> list[str]:
    found = []
    if already(relation, x, y):
        found.append("already so")
    if narrowest(x) > GRIPPER_M and filled(x) > 0.9:  # a wall, a rim or a handle will do
        found.append("too wide to grasp")
    if relation in ("in", "into", "inside"):
        if not hollow(y):
            found.append("no container")
        if np.sort(x.bounding_box_oriented.primitive.extents)[:2].prod() > np.sort(y.extents)[1:].prod():
            found.append("does not fit")
    if relation == "on" and (hollow(y) or y.extents[:2].min() < 0.03):
        found.append("no stable top")
    return found


def already(relation: str, x: trimesh.Trimesh, y: trimesh.Trimesh) -> bool:
    (x_low, x_high), (y_low, y_high) = x.bounds, y.bounds
    between = (x_low + x_high) / 2 - (y_low + y_high) / 2
    low_in_x = np.append(((x_low + x_high) / 2)[:2], x_low[2] + 0.01)  # a pear reaches far out of its pan
    contained = bool(y.convex_hull.contains([low_in_x])[0]) and x_low[2] < y_high[2] - 0.01
    if relation in ("in", "into", "inside"):
        return contained and hollow(y)
    if relation == "outside":
        return not contained
    if relation == "on":
        over = (np.abs(between[:2]) < (y_high - y_low)[:2] / 2).all()
        return bool(over and abs(x_low[2] - y_high[2]) < 0.01)
    if relation == "next to":
        gap = np.maximum(np.maximum(x_low - y_high, y_low - x_high)[:2], 0)
        return bool(0 < np.hypot(*gap) < 0.03 and x_low[2] < y_high[2] and y_low[2] < x_high[2])
    axis, sign = {"to the left of": (0, -1), "to the right of": (0, 1), "behind": (1, 1), "in front of": (1, -1)}[
        relation
    ]
    apart = (x_low[axis] > y_high[axis]) if sign > 0 else (x_high[axis] < y_low[axis])
    return bool(apart and abs(between[axis]) > abs(between[1 - axis]))


def narrowest(mesh: trimesh.Trimesh) -> float:
    """Least width between two vertical planes, at any height that a finger covers: a neck will do."""
    angles = np.linspace(0, np.pi, 90, endpoint=False)
    directions = np.stack([np.cos(angles), np.sin(angles), np.zeros(90)])
    low, high = mesh.bounds[:, 2]
    cuts = (mesh_plane(mesh, [0, 0, 1], [0, 0, z]) for z in np.linspace(low, high, 14)[1:-1])
    slices = [mesh.vertices, *(cut.reshape(-1, 3) for cut in cuts if len(cut))]
    return min(float(np.ptp(points @ directions, axis=0).min()) for points in slices)


def hollow(mesh: trimesh.Trimesh) -> bool:
    """Whether much of its convex hull is empty: a vessel, a ring, a tool; the hollow of a plate does not count."""
    flat = mesh.extents[2] < 0.15 * mesh.extents[:2].min()
    return not flat and filled(mesh) < 0.7


def filled(mesh: trimesh.Trimesh) -> float:
    """Share of its convex hull that it fills."""
    return abs(mesh.volume) / mesh.convex_hull.volume
