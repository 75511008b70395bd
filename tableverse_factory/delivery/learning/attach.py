"""Scenes attached to other MuJoCo models, with the simulation settings that let them rest.

`MjSpec.attach` keeps the parent's settings. With MuJoCo's defaults things creep: pyramidal cones and an impratio of 1
let leaning things slide, by centimetres in seconds.
"""

import mujoco
import numpy as np

from tableverse_factory.core.errors import ConfigError
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.learning.vector_sim import load_scene_spec
from tableverse_factory.geometry.math.transforms import quaternion_about_z
from tableverse_factory.physics.mjcf.spec import CONTACT_TIME_S, REST_OPTIONS
from tableverse_factory.robotics.robots.station import copy_simulation_settings

_SKYBOX = mujoco.mjtTexture.mjTEXTURE_SKYBOX
_MULTICCD = mujoco.mjtDisableBit.mjDSBL_MULTICCD


def attach_scene(
    parent: mujoco.MjSpec,
    scene: Scene,
    position: tuple[float, float, float] = (0.0, 0.0, 0.0),
    yaw_rad: float = 0.0,
    prefix: str = "scene/",
    visuals: bool = True,
) -> mujoco.MjsFrame:
    """Attach a scene to the world of a specification, and give that the settings with which the scene rests.

    The parent's integrator, friction cone, impratio and no-slip iterations become the scene's, several contacts per
    pair are enabled, and its timestep becomes the scene's where it is longer. Sky and lamp of the scene are left out
    where the parent has its own.

    Args:
        parent: To compile afterwards.
        scene: Of a dataset; its bodies, joints, geoms, … get the `prefix`.
        position: Of the table frame in the world, z up [m].
        yaw_rad: Turn of the table frame about the vertical [rad].
        prefix: Of the scene's names; scenes attached to one parent need different ones.
        visuals: Keep visual geoms.

    Returns:
        The frame below which the scene lies.
    """
    if f"{prefix}table" in {body.name for body in parent.bodies}:
        raise ConfigError(f"prefix {prefix!r}: the model has a scene of this prefix already; give another")
    child = load_scene_spec(scene, visuals)
    option = child.option
    for name in REST_OPTIONS:
        setattr(parent.option, name, getattr(option, name))
    parent.option.timestep = min(parent.option.timestep, option.timestep)
    parent.option.disableflags &= ~int(_MULTICCD)
    if any(texture.type == _SKYBOX for texture in parent.textures):
        for sky in [texture for texture in child.textures if texture.type == _SKYBOX]:
            child.delete(sky)
    if list(parent.lights):
        for light in list(child.lights):
            child.delete(light)
    copy_simulation_settings(child, parent)  # MuJoCo warns of every difference
    frame = parent.worldbody.add_frame(pos=position, quat=quaternion_about_z(yaw_rad))
    parent.attach(child, frame=frame, prefix=prefix)
    return frame


def find_unfit_settings(model: mujoco.MjModel) -> tuple[str, ...]:
    """Find the settings of a compiled model with which scenes of ours do not rest as certified; a line for each."""
    option = model.opt
    found = [
        f"{name} is {float(getattr(option, name)):g}; scenes rest with {float(value):g}"
        for name, value in REST_OPTIONS.items()
        if getattr(option, name) != value
    ]
    if option.timestep > CONTACT_TIME_S / 2 and not np.isclose(option.timestep, CONTACT_TIME_S / 2):
        found.append(f"timestep is {option.timestep:g} s; contacts are stable up to {CONTACT_TIME_S / 2:g} s")
    if option.disableflags & int(_MULTICCD):
        found.append("multiccd is disabled; scenes rest with several contacts per pair")
    return tuple(found)
