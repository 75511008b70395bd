"""Lamps and cameras of a compiled MuJoCo model, for output formats that show scenes."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64

from schemas.geometry import Frozen, Pose, Vector3
from tableverse_factory.geometry.math.transforms import pose_from_rotation

_ASPECT = 4.0 / 3.0  # of cameras that state only an angle of view


@dataclass(frozen=True, slots=True, eq=False)
class ModelLight(Frozen):
    """Lamp of the world: where its light goes, and the light on a surface that faces it (1 is white)."""

    name: str
    direction: Vector3
    color: Float64[np.ndarray, "3"]


@dataclass(frozen=True, slots=True, eq=False)
class ModelCamera(Frozen):
    """Camera of the world; it looks along -z of its pose, y up. Focal length is 1; `size` is that of its picture.

    `offset` is the middle of the picture from the optical axis, to the right and up.
    """

    name: str
    pose: Pose
    size: Float64[np.ndarray, "2"]
    offset: Float64[np.ndarray, "2"]


def read_lights(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[ModelLight, ...]:
    """Read the lamps that shine; positions in `data` must be computed, lamps included."""
    lit = [k for k in range(model.nlight) if model.light_active[k] and model.light_diffuse[k].any()]
    return tuple(
        ModelLight(model.light(k).name, data.light_xdir[k].copy(), model.light_diffuse[k].astype(np.float64))
        for k in lit
    )


def read_ambient(model: mujoco.MjModel) -> Float64[np.ndarray, "3"]:
    """Read the light that comes from everywhere, and from the viewer's own lamp, which other viewers lack."""
    headlight = model.vis.headlight
    return np.array(headlight.ambient, dtype=np.float64) + 0.5 * np.array(headlight.diffuse) * bool(headlight.active)


def read_cameras(model: mujoco.MjModel, data: mujoco.MjData) -> tuple[ModelCamera, ...]:
    """Read the perspective cameras that are fixed in the world."""
    found = []
    for k in range(model.ncam):
        if model.cam_bodyid[k] != 0:
            continue
        pose = pose_from_rotation(data.cam_xpos[k], data.cam_xmat[k].reshape(3, 3))
        focal, offset = model.cam_intrinsic[k, :2], model.cam_intrinsic[k, 2:] * (1.0, -1.0)
        if model.cam_sensorsize[k].all():
            size, offset = model.cam_sensorsize[k] / focal, offset / focal
        else:
            height = 2 * np.tan(np.deg2rad(model.cam_fovy[k]) / 2)
            size, offset = np.array([_ASPECT * height, height]), np.zeros(2)
        found.append(ModelCamera(model.camera(k).name, pose, size.astype(np.float64), offset.astype(np.float64)))
    return tuple(found)
