"""One MuJoCo model with room for each of several scenes, for simulators whose worlds share a model.

Objects of a scene take its slots, those with most convex pieces first. A slot has as many mesh geoms as the object that
needs most; in other worlds the rest are absent, and so are the objects of unused slots.
"""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.learning.vector_sim import load_scene_spec
from tableverse_factory.physics.simulate.at_rest import find_free_bodies
from tableverse_factory.physics.simulate.sizes import SimulationSizes, measure_sizes
from tableverse_factory.robotics.robots.station import copy_simulation_settings

BODY_FIELDS = ("body_ipos", "body_iquat", "body_mass", "body_subtreemass", "body_inertia", "body_invweight0")
GEOM_FIELDS = ("geom_pos", "geom_quat", "geom_size", "geom_aabb", "geom_rbound", "geom_friction")
_PARKED_M = 10.0  # absent objects float this far below the table, a metre apart


@dataclass(frozen=True, slots=True, eq=False)
class LoadedScene:
    """A compiled scene: its table's geom, and its free bodies with their geoms, those with most geoms first.

    `mesh_names` are the names of its meshes in the template.
    """

    scene_id: str
    model: mujoco.MjModel
    table: int
    objects: tuple[tuple[int, tuple[int, ...]], ...]
    mesh_names: Mapping[str, str]
    sizes: SimulationSizes

    @property
    def object_ids(self) -> tuple[str, ...]:
        """Names of the objects, slot by slot."""
        return tuple(self.model.body(body).name for body, _ in self.objects)


@dataclass(frozen=True, slots=True, eq=False)
class WarpTemplate:
    """The model, and the arrays by field that make a world of it a scene's, in the order of the scenes."""

    model: mujoco.MjModel
    scenes: tuple[LoadedScene, ...]
    worlds: tuple[Mapping[str, np.ndarray], ...]


def build_template(scenes: Sequence[Scene]) -> WarpTemplate:
    """Build the model of different scenes.

    Raises:
        InputError: `bad_scene` if one holds anything but a table that is a box and free bodies of meshes, or has
            another timestep than the first.
    """
    spec = mujoco.MjSpec()
    loaded, assets = [], dict[str, bytes]()
    for number, scene in enumerate(scenes):
        child = load_scene_spec(scene, visuals=False)
        if number == 0:
            copy_simulation_settings(spec, child)
        elif child.option.timestep != spec.option.timestep:
            raise InputError(
                f"scene {scene.scene_id} has another timestep than the first: a batch has one", "bad_scene"
            )
        mesh_names = _add_meshes(spec, child, scene.files(), assets)
        loaded.append(_load(scene.scene_id, child.compile(), mesh_names))
    room = [max(counts) for counts in _transpose([[len(geoms) for _, geoms in one.objects] for one in loaded])]
    _add_slots(spec, loaded[0], room, next(mesh.name for mesh in spec.meshes))
    spec.assets = assets
    model = spec.compile()
    worlds = tuple(_fill(model, one, len(room)) for one in loaded)
    return WarpTemplate(model, tuple(loaded), worlds)


def _transpose(rows: Sequence[Sequence[int]]) -> list[list[int]]:
    """Columns of rows of different lengths, with 0 where a row is too short."""
    longest = max(len(row) for row in rows)
    return [[row[k] if k < len(row) else 0 for row in rows] for k in range(longest)]


def _add_meshes(
    spec: mujoco.MjSpec, child: mujoco.MjSpec, files: Mapping[str, bytes], assets: dict[str, bytes]
) -> dict[str, str]:
    """Add the meshes of a scene that the model does not have yet; return their names there by those of the scene."""
    names = {}
    for mesh in child.meshes:
        content = files[f"assets/{mesh.file}"]
        name = hashlib.sha256(content).hexdigest()  # cousins share meshes with their parent and one another
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX  # the compiler makes hulls of unused meshes too then
        if f"{name}.obj" not in assets:
            assets[f"{name}.obj"] = content
            spec.add_mesh(name=name, file=f"{name}.obj", inertia=mesh.inertia)
        names[mesh.name] = name
    return names


def _load(scene_id: str, model: mujoco.MjModel, mesh_names: Mapping[str, str]) -> LoadedScene:
    free = find_free_bodies(model)
    still = [g for g in range(model.ngeom) if model.geom_bodyid[g] not in free]
    is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    boxes = [g for g in still if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX]
    moving = [g for g in range(model.ngeom) if g not in still]
    if len(still) != 1 or still != boxes or len(free) != model.njnt or not free or not is_mesh[moving].all():
        raise InputError(
            f"scene {scene_id}: a batch takes a table that is a box, and free bodies of meshes", "bad_scene"
        )
    geoms = {body: tuple(np.flatnonzero(model.geom_bodyid == body).tolist()) for body in free}
    objects = tuple(sorted(geoms.items(), key=lambda item: (-len(item[1]), item[0])))
    return LoadedScene(scene_id, model, still[0], objects, mesh_names, measure_sizes(model))


def _add_slots(spec: mujoco.MjSpec, example: LoadedScene, room: Sequence[int], mesh: str) -> None:
    """Add the table, and a free body per slot with its geoms; weights and shapes are those of each world."""
    # a mocap body, as the poses of static ones are computed once for all worlds
    table = spec.worldbody.add_body(name="table", mocap=True).add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[1.0] * 3)
    _copy_contact(table, example.model, example.table)
    first = example.objects[0][1][0]
    for slot, pieces in enumerate(room):
        body = spec.worldbody.add_body(name=f"slot_{slot:02d}", gravcomp=1.0)
        # off its frame, as MuJoCo has a faster way for bodies whose centre is their frame's origin
        body.mass, body.ipos, body.inertia, body.explicitinertial = 1.0, [0.01] * 3, [1e-3] * 3, True
        body.add_freejoint()
        for _ in range(pieces):
            geom = body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=mesh)
            _copy_contact(geom, example.model, first)


def _copy_contact(geom: mujoco.MjsGeom, model: mujoco.MjModel, source: int) -> None:
    geom.condim, geom.solref, geom.solimp = (
        model.geom_condim[source],
        model.geom_solref[source],
        model.geom_solimp[source],
    )


def _fill(model: mujoco.MjModel, scene: LoadedScene, slots: int) -> dict[str, np.ndarray]:
    """Make the arrays of one world."""
    own = scene.model
    names = (*BODY_FIELDS, *GEOM_FIELDS, "body_pos", "body_quat", "body_gravcomp", "qpos0", "dof_invweight0")
    arrays = {name: np.array(getattr(model, name)) for name in (*names, "geom_dataid")}
    arrays["body_pos"][1], arrays["body_quat"][1] = _world_pose(own, int(own.geom_bodyid[scene.table]))
    arrays["geom_dataid"][1:] = -1
    for name in GEOM_FIELDS:
        arrays[name][0] = getattr(own, name)[scene.table]
    arrays["qpos0"].reshape(-1, 7)[:] = [[0.0, 0.0, -_PARKED_M - slot, 1.0, 0.0, 0.0, 0.0] for slot in range(slots)]
    for slot, (body, geoms) in enumerate(scene.objects):
        to = 2 + slot
        for name in BODY_FIELDS:
            arrays[name][to] = getattr(own, name)[body]
        arrays["body_gravcomp"][to] = 0.0
        start, dof = int(own.jnt_qposadr[own.body_jntadr[body]]), int(own.body_dofadr[body])
        arrays["qpos0"][7 * slot : 7 * slot + 7] = own.qpos0[start : start + 7]
        arrays["dof_invweight0"][6 * slot : 6 * slot + 6] = own.dof_invweight0[dof : dof + 6]
        first = int(model.body_geomadr[to])
        for geom, source in enumerate(geoms, first):
            for name in GEOM_FIELDS:
                arrays[name][geom] = getattr(own, name)[source]
            arrays["geom_dataid"][geom] = model.mesh(scene.mesh_names[own.mesh(int(own.geom_dataid[source])).name]).id
    arrays["body_subtreemass"][0] = arrays["body_mass"].sum()
    arrays["body_pos"][2:], arrays["body_quat"][2:] = np.split(arrays["qpos0"].reshape(-1, 7), [3], axis=1)
    return arrays


def _world_pose(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, np.ndarray]:
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    return data.xpos[body].copy(), data.xquat[body].copy()
