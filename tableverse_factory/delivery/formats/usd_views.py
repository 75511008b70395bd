"""Lamps and cameras of a USD stage."""

from typing import TYPE_CHECKING

import numpy as np

from tableverse_factory.delivery.formats.model_contents import ModelContents
from tableverse_factory.delivery.formats.model_views import ModelCamera, ModelLight
from tableverse_factory.geometry.math.transforms import quaternion_from_matrix

if TYPE_CHECKING:
    from pxr import Usd

# A focal length of 20 mm, in tenths of a stage unit as USD has it; the stage is in metres.
_FOCAL = 0.2
_NEAR_FAR_M = (0.01, 100.0)


def add_lights(stage: "Usd.Stage", path: str, contents: ModelContents) -> None:
    """Add a dome of even light, and a distant light for each lamp."""
    from pxr import Gf, UsdGeom, UsdLux

    UsdGeom.Scope.Define(stage, path)
    dome = UsdLux.DomeLight.Define(stage, f"{path}/dome")
    strength = float(contents.ambient.max())
    dome.CreateIntensityAttr(strength)
    dome.CreateColorAttr(Gf.Vec3f(*(contents.ambient / max(strength, 1e-9)).tolist()))
    for index, light in enumerate(contents.lights):
        _add_light(stage, f"{path}/lamp_{index:02d}", light)


def _add_light(stage: "Usd.Stage", path: str, light: ModelLight) -> None:
    from pxr import Gf, UsdGeom, UsdLux

    lamp = UsdLux.DistantLight.Define(stage, path)
    strength = float(light.color.max())
    lamp.CreateNormalizeAttr(True)  # the intensity is then the irradiance, which a white surface spreads over pi
    lamp.CreateIntensityAttr(float(np.pi) * strength)
    lamp.CreateColorAttr(Gf.Vec3f(*(light.color / strength).tolist()))
    lamp.CreateAngleAttr(2.0)
    lamp.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(*_turn_to(light.direction).tolist()))
    lamp.GetPrim().SetDisplayName(light.name or "lamp")


def _turn_to(direction: np.ndarray) -> np.ndarray:
    """Compute the quaternion wxyz of a frame whose -z is the direction."""
    z = -direction / np.linalg.norm(direction)
    x = np.cross([0.0, 1.0, 0.0] if abs(z[1]) < 0.9 else [1.0, 0.0, 0.0], z)
    x /= np.linalg.norm(x)
    return quaternion_from_matrix(np.stack([x, np.cross(z, x), z], axis=1))


def add_cameras(stage: "Usd.Stage", path: str, contents: ModelContents) -> None:
    """Add the cameras."""
    from pxr import UsdGeom

    if contents.cameras:
        UsdGeom.Scope.Define(stage, path)
    for index, camera in enumerate(contents.cameras):
        _add_camera(stage, f"{path}/camera_{index:02d}", camera)


def _add_camera(stage: "Usd.Stage", path: str, camera: ModelCamera) -> None:
    from pxr import Gf, UsdGeom

    eye = UsdGeom.Camera.Define(stage, path)
    eye.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*camera.pose.position.tolist()))
    turn = Gf.Quatd(*camera.pose.quaternion_wxyz.tolist())
    eye.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(turn)
    eye.CreateFocalLengthAttr(_FOCAL)
    width, height = (_FOCAL * camera.size).tolist()
    right, up = (_FOCAL * camera.offset).tolist()
    eye.CreateHorizontalApertureAttr(width)
    eye.CreateVerticalApertureAttr(height)
    eye.CreateHorizontalApertureOffsetAttr(right)
    eye.CreateVerticalApertureOffsetAttr(up)
    eye.CreateClippingRangeAttr(Gf.Vec2f(*_NEAR_FAR_M))
    eye.GetPrim().SetDisplayName(camera.name or "camera")
