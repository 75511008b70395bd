"""Many scenes in one MuJoCo model, on a grid, with prefixed names and no contacts between scenes.

Up to 31 scenes collide by separate bits; further ones share them and are separated by distance alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Picture, TriangleMesh
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.learning.vector_sim import load_scene_spec
from tableverse_factory.physics.mjcf.scene_objects import read_slab
from tableverse_factory.physics.mjcf.scenery import make_geom_box, read_geom_color, read_geom_mesh
from tableverse_factory.physics.mjcf.spec import VISUAL_GROUP
from tableverse_factory.physics.render.render import look_at, render
from tableverse_factory.physics.render.views import frame_points
from tableverse_factory.robotics.robots.station import copy_simulation_settings

_AISLE_M = 0.4  # gap between the circles around the tables
_BITS = 31  # number of separate collision bits


@dataclass(frozen=True, slots=True, eq=False)
class SceneGrid(Frozen):
    """Scenes in one compiled model.

    Attributes:
        prefixes: Name prefix of each scene: `s00/`, `s01/`, …; a table is `s00/table`, an object `s00/obj_000`.
        origins: Of each scene's table frame in the world [m]. Shape (n, 3).
    """

    model: mujoco.MjModel
    scene_ids: tuple[str, ...]
    prefixes: tuple[str, ...]
    origins: Float64[np.ndarray, "n 3"]

    def object_ids(self, number: int) -> tuple[str, ...]:
        """Return a scene's objects without prefix, in the order of the model."""
        names = (self.model.body(int(self.model.jnt_bodyid[joint])).name for joint in self._joints(number))
        return tuple(name.removeprefix(self.prefixes[number]) for name in names)

    def poses(self, data: mujoco.MjData, number: int) -> Float64[np.ndarray, "m 7"]:
        """Return position [m] and quaternion wxyz of a scene's objects in its own table frame, as in `object_ids`."""
        starts = np.array([int(self.model.jnt_qposadr[joint]) for joint in self._joints(number)], dtype=np.intp)
        poses: Float64[np.ndarray, "m 7"] = data.qpos[starts[:, None] + np.arange(7)]
        poses[:, :3] -= self.origins[number]
        return poses

    def picture(self, data: mujoco.MjData, width: int = 960, height: int = 600) -> Picture:
        """Render all scenes from the front and above, ray-cast on the CPU; positions in `data` must be computed."""
        parts, colors = [], []
        for geom in range(self.model.ngeom):
            mesh = _load_drawn_mesh(self.model, geom)
            if mesh is not None:
                turn = data.geom_xmat[geom].reshape(3, 3)
                parts.append(replace(mesh, vertices=mesh.vertices @ turn.T + data.geom_xpos[geom]))
                colors.append(None if mesh.texture is not None else read_geom_color(self.model, geom))
        around = np.concatenate([[part.vertices.min(axis=0), part.vertices.max(axis=0)] for part in parts])
        eye = frame_points(around, look_at(np.array([0.0, -1.0, 0.9]), np.zeros(3)), width, height)
        return render(parts, eye.camera, eye.camera_to_table, paints=colors).color

    def _joints(self, number: int) -> list[int]:
        free = np.flatnonzero(self.model.jnt_type == mujoco.mjtJoint.mjJNT_FREE)
        bodies = [self.model.body(int(body)).name for body in self.model.jnt_bodyid[free]]
        return [int(j) for j, name in zip(free, bodies, strict=True) if name.startswith(self.prefixes[number])]


def build_scene_grid(scenes: Sequence[Scene], spacing_m: float | None = None, visuals: bool = False) -> SceneGrid:
    """Attach scenes to one specification and compile it, with the first scene's settings.

    Args:
        scenes: May contain a scene more than once.
        spacing_m: Between the tables' origins; by default the largest table plus an aisle.
        visuals: Keep visual geoms, for pictures.

    Raises:
        InputError: if a scene does not load, or has another timestep than the first.
    """
    if not scenes:
        raise ConfigError("no scenes: give at least one")
    spacing = _choose_spacing(scenes, spacing_m)
    columns = int(np.ceil(np.sqrt(len(scenes))))
    origins = np.array([[k % columns * spacing, k // columns * spacing, 0.0] for k in range(len(scenes))])
    prefixes = tuple(f"s{k:02d}/" for k in range(len(scenes)))
    whole = mujoco.MjSpec()
    whole.modelname = "grid"
    whole.compiler.discardvisual = not visuals
    for k, scene in enumerate(scenes):
        child = load_scene_spec(scene, visuals)
        if k == 0:
            copy_simulation_settings(whole, child)
        elif child.option.timestep != whole.option.timestep:
            steps = f"{child.option.timestep:g} s, and the first one has {whole.option.timestep:g} s"
            raise InputError(f"scene {scene.scene_id} has a timestep of {steps}: one model has one", "other_timestep")
        _isolate_collisions(child, 1 << k % _BITS, first=k == 0)
        copy_simulation_settings(child, whole)
        whole.attach(child, frame=whole.worldbody.add_frame(pos=origins[k]), prefix=prefixes[k])
    try:
        return SceneGrid(whole.compile(), tuple(scene.scene_id for scene in scenes), prefixes, origins)
    except ValueError as error:
        raise InputError(f"the scenes do not load as one: {sanitize_line(str(error), 500)}", "bad_mjcf") from error


def _load_drawn_mesh(model: mujoco.MjModel, geom: int) -> TriangleMesh | None:
    """Load a drawn geom in its own frame: visuals of objects, and boxes of tables."""
    kind = int(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return make_geom_box(model, geom)
    if kind == mujoco.mjtGeom.mjGEOM_MESH and int(model.geom_group[geom]) == VISUAL_GROUP:
        return read_geom_mesh(model, geom)
    return None


def _isolate_collisions(child: mujoco.MjSpec, bit: int, first: bool) -> None:
    """Restrict collisions to the own scene; sky and lights are the first scene's."""
    for geom in child.geoms:
        if geom.contype or geom.conaffinity:
            geom.contype, geom.conaffinity = bit, bit
    if not first:
        for texture in [texture for texture in child.textures if texture.type == mujoco.mjtTexture.mjTEXTURE_SKYBOX]:
            child.delete(texture)
        for light in list(child.lights):
            child.delete(light)


def _choose_spacing(scenes: Sequence[Scene], asked_m: float | None) -> float:
    """Check the requested spacing, or choose one that separates circles around whole tables [m]."""
    if asked_m is not None and not 0.0 < asked_m < np.inf:
        raise ConfigError(f"spacing_m {asked_m}: give a length above 0 m, or None")
    if asked_m is not None and len(scenes) <= _BITS:
        return asked_m
    slabs = [read_slab(scene.files()) for scene in scenes]
    width = 2 * max(float(np.linalg.norm(slab.center_xy) + np.linalg.norm(slab.half_size_xy)) for slab in slabs)
    if asked_m is not None and asked_m < width:
        needed = f"give {np.ceil(100 * width) / 100:g} m or more, or at most {_BITS} scenes"
        raise ConfigError(f"spacing_m {asked_m:g}: {len(scenes)} scenes would touch one another; {needed}")
    return width + _AISLE_M if asked_m is None else asked_m
