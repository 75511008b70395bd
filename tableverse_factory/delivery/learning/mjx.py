"""Scenes for MJX, which tests every pair of colliders at every step, and ignores what it cannot do.

MJX reserves four contacts for each pair of convex pieces that may ever touch, and traces and compiles code for them: a
scene of 180 pieces takes 50,000, and minutes. So each thing gets as few colliders as hold the scene without collisions.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations

import mujoco
import numpy as np

from schemas.geometry import Points
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.learning.vector_sim import load_scene_spec
from tableverse_factory.geometry.convex.cut_and_merge import PieceCluster, make_cluster, merge_clusters
from tableverse_factory.geometry.math.transforms import rotation_matrix
from tableverse_factory.physics.simulate.at_rest import find_free_bodies, make_quiet_data

MAX_CONTACTS = 2000
MAX_VERTICES = 16  # of a merged piece; the time to compile and to step grows with their product
CONTACTS_PER_PAIR = 4
DEPTH_M = 0.0005  # merged pieces of two things may overlap by this at most


def load_mjx_spec(scene: Scene, max_contacts: int = MAX_CONTACTS, max_vertices: int = MAX_VERTICES) -> mujoco.MjSpec:
    """Load a scene with few colliders: compile it, and give the model to `mjx.put_model`.

    A thing begins with one hull. Where two things overlap then, the one whose hull adds more gets twice the pieces,
    merged from its own. There are no no-slip iterations, which MJX would ignore.

    Args:
        scene: Of a dataset, without an arm.
        max_contacts: Most contacts that MJX may reserve; the time to compile and to step grows with them.
        max_vertices: Most corners of a hull: with few, round things lose their rims and roll.

    Raises:
        InputError: `too_many_contacts` where things only fit together in their full shapes, as in a full bowl.
    """
    spec = load_scene_spec(scene, visuals=False)
    spec.option.noslip_iterations = 0
    model = spec.compile()
    pieces = {model.body(body).name: _list_clusters(model, body) for body in find_free_bodies(model)}
    counts = dict.fromkeys(pieces, 1)
    merged = {name: merge_clusters(its, 1, 0.0) for name, its in pieces.items()}
    while True:
        _check_contacts(scene.scene_id, [len(its) for its in merged.values()], max_contacts)
        candidate = _replace_colliders(spec, merged, max_vertices)
        crowded = _find_crowded(candidate.compile(), pieces, merged)
        if not crowded:
            return candidate
        for name in crowded:
            counts[name] = min(2 * counts[name], len(pieces[name]))
            merged[name] = merge_clusters(pieces[name], counts[name], 0.0)


def count_mjx_contacts(pieces: Sequence[int]) -> int:
    """Count the contacts that MJX reserves for things of so many pieces on a table."""
    return CONTACTS_PER_PAIR * sum(a * b for a, b in combinations([1, *pieces], 2))


def _check_contacts(scene_id: str, pieces: Sequence[int], most: int) -> None:
    if (needed := count_mjx_contacts(pieces)) > most:
        raise InputError(
            f"scene {scene_id}: MJX would reserve {needed} contacts for {sum(pieces)} colliders, more than {most}; "
            "things in it fit together only in their full shapes: take MuJoCo or MuJoCo Warp",
            "too_many_contacts",
        )


def _list_clusters(model: mujoco.MjModel, body: int) -> list[PieceCluster]:
    """Points of each piece of a body, in its frame."""
    return [make_cluster(_read_points(model, geom)) for geom in np.flatnonzero(model.geom_bodyid == body).tolist()]


def _read_points(model: mujoco.MjModel, geom: int) -> Points:
    mesh = int(model.geom_dataid[geom])
    first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
    points = model.mesh_vert[first : first + count].astype(np.float64)
    return points @ rotation_matrix(model.geom_quat[geom]).T + model.geom_pos[geom]


def _replace_colliders(
    spec: mujoco.MjSpec, merged: Mapping[str, Sequence[PieceCluster]], max_vertices: int
) -> mujoco.MjSpec:
    """Copy the specification with merged pieces in place of each body's own, with contact parameters of those."""
    copy = spec.copy()
    for name, clusters in merged.items():
        geoms = list(copy.body(name).geoms)
        for geom in geoms[len(clusters) :]:
            copy.delete(geom)
        for number, (geom, cluster) in enumerate(zip(geoms, clusters, strict=False)):
            mesh = copy.add_mesh(name=f"{name}_merged_{number:02d}", maxhullvert=max_vertices)
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
            mesh.uservert = cluster.points.ravel()
            geom.meshname = mesh.name
    used = {geom.meshname for geom in copy.geoms}
    for mesh in list(copy.meshes):
        if mesh.name not in used:
            copy.delete(mesh)
    return copy


def _find_crowded(
    model: mujoco.MjModel, pieces: Mapping[str, Sequence[PieceCluster]], merged: Mapping[str, Sequence[PieceCluster]]
) -> set[str]:
    """Find the things to give more pieces: of two that overlap, the one whose merged pieces add more volume."""
    data = make_quiet_data(model)
    mujoco.mj_forward(model, data)
    added = {
        name: sum(its.volume for its in merged[name]) - sum(its.volume for its in own)
        for name, own in pieces.items()
        if len(merged[name]) < len(own)
    }
    crowded = set()
    for pair in data.contact.geom[data.contact.dist < -DEPTH_M].tolist():
        names = [model.body(int(model.geom_bodyid[geom])).name for geom in pair]
        if candidates := [name for name in names if name in added]:
            crowded.add(max(candidates, key=added.__getitem__))
    return crowded
