"""USD with physics: rigid bodies with mass and inertia, convex colliders, preview surfaces; z up, meters.

Lamps and cameras are those of the model, with UsdLux's intensities: a lamp of 1 lights white as bright as white is.
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from schemas.geometry import Matrix3, Quaternion, TriangleMesh
from schemas.identity import make_file_stem
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.core.png import encode_png
from tableverse_factory.delivery.formats.model_contents import ModelContents, ModelObject, VisualMesh
from tableverse_factory.delivery.formats.usd_views import add_cameras, add_lights
from tableverse_factory.geometry.math.transforms import quaternion_from_matrix
from tableverse_factory.geometry.mesh.distinct_rows import find_distinct_rows
from tableverse_factory.physics.render.normals import compute_corner_normals

if TYPE_CHECKING:
    from pxr import Sdf, Usd, UsdGeom, UsdShade

ROOT = "/World"
TEXTURES = "textures"


def encode_usd(contents: ModelContents, labels: Mapping[str, str]) -> dict[str, bytes]:
    """Encode `scene.usd` (binary) and its pictures under `textures/`, by path.

    Prims are named after the objects as far as USD allows; object ids and `labels`, untrusted text, are in
    `customData`.
    """
    import_extra("pxr", "USD", "usd")
    from pxr import Usd, UsdGeom, UsdPhysics

    files: dict[str, bytes] = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scene.usd"
        stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdPhysics.SetStageKilogramsPerUnit(stage, 1.0)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, ROOT).GetPrim())
        physics = UsdPhysics.Scene.Define(stage, f"{ROOT}/physics")
        physics.CreateGravityDirectionAttr((0.0, 0.0, -1.0))
        physics.CreateGravityMagnitudeAttr(9.81)
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
        _add_mass(body, content)
    UsdSemantics.LabelsAPI.Apply(body.GetPrim(), "class").CreateLabelsAttr([label or content.name])
    files: dict[str, bytes] = {}
    stem = make_file_stem(content.name)
    for index, look in enumerate(content.looks):
        files |= _add_visual(stage, f"{path}/look_{index:02d}", look, f"{stem}_{index:02d}")
    _add_colliders(stage, path, content)
    return files


def _find_free_path(stage: "Usd.Stage", name: str) -> str:
    path, count = f"{ROOT}/{name}", 1
    while stage.GetPrimAtPath(path):
        count += 1
        path = f"{ROOT}/{name}_{count}"
    return path


def _add_mass(body: "UsdGeom.Xform", content: ModelObject) -> None:
    from pxr import Gf, UsdPhysics

    UsdPhysics.RigidBodyAPI.Apply(body.GetPrim())
    mass = UsdPhysics.MassAPI.Apply(body.GetPrim())
    moments, axes = compute_principal_axes(content.inertia)
    mass.CreateMassAttr(content.mass_kg)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*content.center.tolist()))
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments.tolist()))
    mass.CreatePrincipalAxesAttr(Gf.Quatf(*axes.tolist()))


def compute_principal_axes(inertia: Matrix3) -> tuple[np.ndarray, Quaternion]:
    """Compute principal moments [kg m²], smallest first, and the rotation of their right-handed axes."""
    moments, axes = np.linalg.eigh(inertia)
    if np.linalg.det(axes) < 0.0:
        axes[:, 2] *= -1.0
    return moments, quaternion_from_matrix(axes)


def _add_visual(stage: "Usd.Stage", path: str, look: VisualMesh, stem: str) -> dict[str, bytes]:
    from pxr import Gf, Sdf, UsdShade

    mesh = _define_mesh(stage, path, look.mesh)
    material = UsdShade.Material.Define(stage, f"{path}/material")
    surface = UsdShade.Shader.Define(stage, f"{path}/material/surface")
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(material)
    color = surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
    texture = look.mesh.texture
    if texture is None:
        plain = Gf.Vec3f(*((np.array(look.color) / 255.0) ** 2.2).tolist())  # USD's colours are linear
        color.Set(plain)
        mesh.CreateDisplayColorAttr([plain])
        return {}
    _set_at_corners(mesh, "st", Sdf.ValueTypeNames.TexCoord2fArray, texture.corner_uv)
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


def _add_colliders(stage: "Usd.Stage", path: str, content: ModelObject) -> None:
    from pxr import UsdGeom, UsdPhysics, UsdShade

    material = UsdShade.Material.Define(stage, f"{path}/contact")
    contact = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    contact.CreateStaticFrictionAttr(content.friction)
    contact.CreateDynamicFrictionAttr(content.friction)
    for index, hull in enumerate(content.hulls):
        piece = _define_mesh(stage, f"{path}/piece_{index:02d}", hull)
        piece.CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(piece.GetPrim())
        UsdPhysics.MeshCollisionAPI.Apply(piece.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
        binding = UsdShade.MaterialBindingAPI.Apply(piece.GetPrim())
        binding.Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")


def _define_mesh(stage: "Usd.Stage", path: str, mesh: TriangleMesh) -> "UsdGeom.Mesh":
    from pxr import Sdf, UsdGeom, Vt

    prim = UsdGeom.Mesh.Define(stage, path)
    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray(len(mesh.faces), 3))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces.reshape(-1))))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    _set_at_corners(prim, "normals", Sdf.ValueTypeNames.Normal3fArray, compute_corner_normals(mesh))
    prim.CreateExtentAttr([vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()])
    return prim


def _set_at_corners(
    mesh: "UsdGeom.Mesh", name: str, kind: "Sdf.ValueTypeName", values: Float[np.ndarray, "m 3 k"]
) -> None:
    """Set a primvar at each face's corners, its distinct values indexed."""
    from pxr import UsdGeom, Vt

    distinct, index = find_distinct_rows(values.reshape(-1, values.shape[2]).astype(np.float32))
    array = Vt.Vec3fArray if values.shape[2] == 3 else Vt.Vec2fArray
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(name, kind, UsdGeom.Tokens.faceVarying)
    primvar.Set(array.FromNumpy(np.ascontiguousarray(distinct)))
    primvar.SetIndices(Vt.IntArray.FromNumpy(index.astype(np.int32)))
