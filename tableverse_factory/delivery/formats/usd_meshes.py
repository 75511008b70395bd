"""Triangle meshes of a USD stage, and surfaces of their materials."""

from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from schemas.geometry import TriangleMesh
from tableverse_factory.geometry.mesh.distinct_rows import find_distinct_rows
from tableverse_factory.physics.render.normals import compute_corner_normals

if TYPE_CHECKING:
    from pxr import Sdf, Usd, UsdGeom, UsdShade


def define_mesh(stage: "Usd.Stage", path: str, mesh: TriangleMesh) -> "UsdGeom.Mesh":
    """Define a mesh with normals at its faces' corners."""
    from pxr import Sdf, UsdGeom, Vt

    prim = UsdGeom.Mesh.Define(stage, path)
    vertices = np.ascontiguousarray(mesh.vertices, dtype=np.float32)
    prim.CreatePointsAttr(Vt.Vec3fArray.FromNumpy(vertices))
    prim.CreateFaceVertexCountsAttr(Vt.IntArray(len(mesh.faces), 3))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(mesh.faces.reshape(-1))))
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    set_at_corners(prim, "normals", Sdf.ValueTypeNames.Normal3fArray, compute_corner_normals(mesh))
    prim.CreateExtentAttr([vertices.min(axis=0).tolist(), vertices.max(axis=0).tolist()])
    return prim


def set_at_corners(
    mesh: "UsdGeom.Mesh", name: str, kind: "Sdf.ValueTypeName", values: Float[np.ndarray, "m 3 k"]
) -> None:
    """Set a primvar at each face's corners, its distinct values indexed."""
    from pxr import UsdGeom, Vt

    distinct, index = find_distinct_rows(values.reshape(-1, values.shape[2]).astype(np.float32))
    array = Vt.Vec3fArray if values.shape[2] == 3 else Vt.Vec2fArray
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar(name, kind, UsdGeom.Tokens.faceVarying)
    primvar.Set(array.FromNumpy(np.ascontiguousarray(distinct)))
    primvar.SetIndices(Vt.IntArray.FromNumpy(index.astype(np.int32)))


def define_surface(stage: "Usd.Stage", material: "UsdShade.Material") -> "UsdShade.Input":
    """Give a material a dull preview surface; its color, returned, is yet to be set or connected."""
    from pxr import Sdf, UsdShade

    surface = UsdShade.Shader.Define(stage, material.GetPath().AppendChild("surface"))
    surface.CreateIdAttr("UsdPreviewSurface")
    surface.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.8)
    surface.CreateInput("metallic", Sdf.ValueTypeNames.Float).Set(0.0)
    material.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    return surface.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f)
