"""USD with physics: rigid bodies with mass and inertia, convex colliders, preview surfaces; z up, meters.

Lamps and cameras are those of the model, with UsdLux's intensities: a lamp of 1 lights white as bright as white is.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from schemas.identity import make_file_stem
from tableverse_factory.core.png import encode_png
from tableverse_factory.delivery.formats.model_contents import ModelContents, ModelObject, VisualMesh
from tableverse_factory.delivery.formats.usd_meshes import define_mesh, define_surface, set_at_corners
from tableverse_factory.delivery.formats.usd_physics import (
    add_colliders,
    add_mass,
    add_solver_settings,
    set_visual_group,
)
from tableverse_factory.delivery.formats.usd_views import add_cameras, add_lights

if TYPE_CHECKING:
    from pxr import Usd, UsdShade

ROOT = "/World"
TEXTURES = "textures"


def encode_usd(contents: ModelContents, labels: Mapping[str, str]) -> dict[str, bytes]:
    """Encode `scene.usd` (binary) and its pictures under `textures/`, by path.

    Prims are named after the objects as far as USD allows; object ids and `labels`, untrusted text, are in
    `customData`.
    """
    from pxr import Usd, UsdGeom, UsdPhysics

    files: dict[str, bytes] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.usd"
        stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())
        add_solver_settings(stage, f"{ROOT}/physics", contents.solver)
        add_lights(stage, f"{ROOT}/lights", contents)
        add_cameras(stage, f"{ROOT}/cameras", contents)
        for content in contents.still:
            files |= _add_object(stage, content, None)
        for content in contents.objects:
            files |= _add_object(stage, content, labels.get(content.name, ""))
        stage.GetRootLayer().Save()
        return {"scene.usd": path.read_bytes(), **files}


def _add_object(stage: "Usd.Stage", content: ModelObject, label: str | None) -> dict[str, bytes]:
    """Add an object, static if its label is None."""
    from pxr import Gf, Tf, UsdGeom, UsdSemantics

    path = _find_free_path(stage, Tf.MakeValidIdentifier(content.name))
    body = UsdGeom.Xform.Define(stage, path)
    body.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(*content.pose.position.tolist()))
    turn = Gf.Quatd(*content.pose.quaternion_wxyz.tolist())
    body.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(turn)
    body.GetPrim().SetCustomDataByKey("object_id", content.name)
    if label is not None:
        body.GetPrim().SetCustomDataByKey("label", label)
        body.GetPrim().SetDisplayName(label or content.name)
        add_mass(body, content)
    UsdSemantics.LabelsAPI.Apply(body.GetPrim(), "class").CreateLabelsAttr([label or content.name])
    files: dict[str, bytes] = {}
    stem = make_file_stem(content.name)
    for index, look in enumerate(content.looks):
        files |= _add_visual(stage, f"{path}/look_{index:02d}", look, f"{stem}_{index:02d}")
    add_colliders(stage, path, content)
    return files


def _find_free_path(stage: "Usd.Stage", name: str) -> str:
    path, count = f"{ROOT}/{name}", 1
    while stage.GetPrimAtPath(path):
        count += 1
        path = f"{ROOT}/{name}_{count}"
    return path


def _add_visual(stage: "Usd.Stage", path: str, look: VisualMesh, stem: str) -> dict[str, bytes]:
    from pxr import Gf, Sdf, UsdShade

    mesh = define_mesh(stage, path, look.mesh)
    set_visual_group(mesh.GetPrim())
    material = UsdShade.Material.Define(stage, f"{path}/material")
    color = define_surface(stage, material)
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    texture = look.mesh.texture
    if texture is None:
        plain = Gf.Vec3f(*((np.array(look.color) / 255.0) ** 2.2).tolist())  # USD's colours are linear
        color.Set(plain)
        mesh.CreateDisplayColorAttr([plain])
        return {}
    set_at_corners(mesh, "st", Sdf.ValueTypeNames.TexCoord2fArray, texture.corner_uv)
    _add_texture(stage, f"{path}/material", color, f"./{TEXTURES}/{stem}.png")
    return {f"{TEXTURES}/{stem}.png": encode_png(np.asarray(texture.picture))}


def _add_texture(stage: "Usd.Stage", path: str, color: "UsdShade.Input", file: str) -> None:
    from pxr import Sdf, UsdShade

    reader = UsdShade.Shader.Define(stage, f"{path}/points")
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", Sdf.ValueTypeNames.String).Set("st")
    picture = UsdShade.Shader.Define(stage, f"{path}/picture")
    picture.CreateIdAttr("UsdUVTexture")
    picture.CreateInput("file", Sdf.ValueTypeNames.Asset).Set(file)
    picture.CreateInput("sourceColorSpace", Sdf.ValueTypeNames.Token).Set("sRGB")
    for side in ("wrapS", "wrapT"):
        picture.CreateInput(side, Sdf.ValueTypeNames.Token).Set("repeat")  # a table's texture is a tile
    picture.CreateInput("st", Sdf.ValueTypeNames.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    reader.CreateOutput("result", Sdf.ValueTypeNames.Float2)
    picture.CreateOutput("rgb", Sdf.ValueTypeNames.Float3)
    color.ConnectToSource(picture.ConnectableAPI(), "rgb")
