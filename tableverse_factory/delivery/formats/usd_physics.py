"""Masses, colliders, friction and solver settings of a USD stage.

What UsdPhysics has no words for stands in the attributes of MuJoCo's and Newton's schemas, by name, as usd-core lacks
these schemas: `mjc:…` is read by MuJoCo's importer and by Newton's, `newton:…` by both too. Other readers ignore them.
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from schemas.geometry import Matrix3, Quaternion
from tableverse_factory.delivery.formats.model_contents import ModelObject
from tableverse_factory.delivery.formats.model_settings import ContactSettings, SolverSettings
from tableverse_factory.delivery.formats.usd_meshes import define_mesh, define_surface
from tableverse_factory.geometry.math.transforms import quaternion_from_matrix

if TYPE_CHECKING:
    from pxr import Sdf, Usd, UsdGeom, UsdShade

_VISUAL_GROUP, _COLLISION_GROUP = 2, 3  # as in scene.xml
_VARYING = ("newton:contactGap", "newton:torsionalFriction", "newton:rollingFriction")


def add_solver_settings(stage: "Usd.Stage", path: str, solver: SolverSettings) -> None:
    """Add the physics scene: gravity, and the settings with which things rest in MuJoCo."""
    from pxr import Sdf, UsdPhysics

    physics = UsdPhysics.Scene.Define(stage, path)
    strength = float(np.linalg.norm(solver.gravity))
    physics.CreateGravityDirectionAttr(tuple(each / strength for each in solver.gravity) if strength else (0, 0, -1))
    physics.CreateGravityMagnitudeAttr(strength)
    types = Sdf.ValueTypeNames
    values = {
        "timestep": (types.Double, solver.timestep),
        "integrator": (types.Token, solver.integrator),
        "cone": (types.Token, solver.cone),
        "impratio": (types.Double, solver.impratio),
        "noslip_iterations": (types.Int, solver.noslip_iterations),
    }
    named = {f"mjc:option:{name}": value for name, value in values.items()}
    _set_attributes(physics.GetPrim(), "MjcSceneAPI", {**named, "mjc:flag:multiccd": (types.Bool, solver.multiccd)})
    rate = {"newton:timeStepsPerSecond": (types.Int, round(1.0 / solver.timestep))}
    _set_attributes(physics.GetPrim(), "NewtonSceneAPI", rate)


def _set_attributes(prim: "Usd.Prim", schema: str, values: "dict[str, tuple[Sdf.ValueTypeName, Any]]") -> None:
    """Set attributes of a schema that usd-core does not know."""
    from pxr import Sdf

    prim.AddAppliedSchema(schema)
    for name, (kind, value) in values.items():
        varies = name in _VARYING
        prim.CreateAttribute(name, kind, False, Sdf.VariabilityVarying if varies else Sdf.VariabilityUniform).Set(value)


def add_mass(body: "UsdGeom.Xform", content: ModelObject) -> None:
    """Make a rigid body of a prim, with the object's mass and inertia."""
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


def set_visual_group(prim: "Usd.Prim") -> None:
    """Put a visual where MuJoCo's viewer shows it."""
    from pxr import Sdf

    _set_attributes(prim, "MjcImageableAPI", {"mjc:group": (Sdf.ValueTypeNames.Int, _VISUAL_GROUP)})


def add_colliders(stage: "Usd.Stage", path: str, content: ModelObject) -> None:
    """Add the convex pieces of an object, each with its contact settings; pieces of equal friction share a material."""
    from pxr import Sdf, UsdGeom, UsdPhysics, UsdShade

    # Newton looks 10 cm around shapes by default
    for_newton = {"newton:contactGap": (Sdf.ValueTypeNames.Float, 0.0)}
    materials: dict[tuple[float, ...], UsdShade.Material] = {}
    for index, (hull, contact) in enumerate(zip(content.hulls, content.contacts, strict=True)):
        if contact.friction not in materials:
            name = f"contact_{len(materials):02d}" if materials else "contact"
            materials[contact.friction] = _define_contact_material(stage, f"{path}/{name}", contact.friction)
        piece = define_mesh(stage, f"{path}/piece_{index:02d}", hull)
        piece.CreatePurposeAttr(UsdGeom.Tokens.guide)
        UsdPhysics.CollisionAPI.Apply(piece.GetPrim())
        UsdPhysics.MeshCollisionAPI.Apply(piece.GetPrim()).CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
        _set_attributes(piece.GetPrim(), "MjcCollisionAPI", _list_mujoco_attributes(contact))
        _set_attributes(piece.GetPrim(), "NewtonCollisionAPI", for_newton)
        binding, material = UsdShade.MaterialBindingAPI.Apply(piece.GetPrim()), materials[contact.friction]
        binding.Bind(material)  # the only one that MuJoCo's importer reads
        binding.Bind(material, UsdShade.Tokens.weakerThanDescendants, "physics")


def _list_mujoco_attributes(contact: ContactSettings) -> "dict[str, tuple[Sdf.ValueTypeName, Any]]":
    from pxr import Sdf, Vt

    types = Sdf.ValueTypeNames
    return {
        "mjc:condim": (types.Int, contact.condim),
        "mjc:group": (types.Int, _COLLISION_GROUP),
        "mjc:solref": (types.DoubleArray, Vt.DoubleArray(contact.solref)),
        "mjc:solimp": (types.DoubleArray, Vt.DoubleArray(contact.solimp)),
    }


def _define_contact_material(stage: "Usd.Stage", path: str, friction: Sequence[float]) -> "UsdShade.Material":
    from pxr import Gf, Sdf, UsdPhysics, UsdShade

    material = UsdShade.Material.Define(stage, path)
    contact = UsdPhysics.MaterialAPI.Apply(material.GetPrim())
    slide, spin, roll = friction
    contact.CreateStaticFrictionAttr(slide)
    contact.CreateDynamicFrictionAttr(slide)
    kind = Sdf.ValueTypeNames.Float
    names = {"newton:torsionalFriction": (kind, spin), "newton:rollingFriction": (kind, roll)}
    _set_attributes(material.GetPrim(), "NewtonMaterialAPI", names)
    define_surface(stage, material).Set(Gf.Vec3f(0.5))  # MuJoCo's importer warns of materials without one
    return material
