"""Scenes in SAPIEN and in ManiSkill, whose scenes make actors in the same way."""

import tempfile
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from schemas.geometry import TriangleMesh
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.learning.vector_sim import compile_scene
from tableverse_factory.geometry.math.transforms import quaternion_about_z
from tableverse_factory.physics.mjcf.obj_assets import encode_obj
from tableverse_factory.physics.simulate.at_rest import make_quiet_data

# At the default of PhysX things that fit closely flew off the table.
DEPENETRATION_M_S = 0.05


def add_to_sapien(
    world: Any,
    scene: Scene,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    yaw_rad: float = 0.0,
    prefix: str = "",
) -> dict[str, Any]:
    """Add table and objects to a `sapien.Scene` or a `ManiSkillScene`, without visuals.

    Sliding friction, masses and inertia are the scene's; PhysX has no rolling friction.

    Args:
        world: To add to; every parallel scene of a `ManiSkillScene` gets the same bodies.
        scene: Of a dataset.
        position: Of the table frame in the world, z up [m].
        yaw_rad: Turn of the table frame about the vertical [rad].
        prefix: Of the actors' names, which ManiSkill wants to be unique.

    Returns:
        The actor of each body, by the body's name. Those of ManiSkill have their pose in `initial_pose`.

    Raises:
        ConfigError: if SAPIEN is not installed.
    """
    try:
        import sapien
    except ImportError:
        raise ConfigError("add_to_sapien needs SAPIEN: pip install sapien") from None
    model = compile_scene(scene, visuals=False)
    data = make_quiet_data(model)
    mujoco.mj_kinematics(model, data)
    frame = sapien.Pose(position, quaternion_about_z(yaw_rad))
    actors = {}
    with tempfile.TemporaryDirectory() as folder:
        for body in range(1, model.nbody):
            name, builder = model.body(body).name, world.create_actor_builder()
            for geom in np.flatnonzero(model.geom_bodyid == body).tolist():
                _add_collision(sapien, builder, model, geom, Path(folder))
            builder.set_initial_pose(frame * sapien.Pose(data.xpos[body], data.xquat[body]))
            if not model.body_jntnum[body]:
                actors[name] = builder.build_static(name=prefix + name)
                continue
            center = sapien.Pose(model.body_ipos[body], model.body_iquat[body])
            builder.set_mass_and_inertia(float(model.body_mass[body]), center, model.body_inertia[body])
            actors[name] = builder.build(name=prefix + name)
            for part in _list_dynamic_parts(sapien, actors[name]):
                part.set_max_depenetration_velocity(DEPENETRATION_M_S)
    return actors


def _add_collision(sapien: Any, builder: Any, model: mujoco.MjModel, geom: int, folder: Path) -> None:
    friction = float(model.geom_friction[geom, 0])
    material = sapien.physx.PhysxMaterial(friction, friction, 0.0)
    pose = sapien.Pose(model.geom_pos[geom], model.geom_quat[geom])
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_BOX:
        builder.add_box_collision(pose, model.geom_size[geom], material)
        return
    mesh = int(model.geom_dataid[geom])
    first, face = int(model.mesh_vertadr[mesh]), int(model.mesh_faceadr[mesh])
    vertices = model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])].astype(np.float64)
    path = folder / f"{mesh}.obj"
    path.write_bytes(encode_obj(TriangleMesh(vertices, model.mesh_face[face : face + int(model.mesh_facenum[mesh])])))
    builder.add_convex_collision_from_file(str(path), pose, (1.0, 1.0, 1.0), material)


def _list_dynamic_parts(sapien: Any, actor: Any) -> list[Any]:
    """List the bodies of an actor: one in SAPIEN, one per parallel scene in ManiSkill."""
    entities = getattr(actor, "_objs", [actor])
    return [its.find_component_by_type(sapien.physx.PhysxRigidDynamicComponent) for its in entities]
