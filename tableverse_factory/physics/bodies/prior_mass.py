"""A body before the judge has spoken: mass and friction as the label suggests."""

from dataclasses import replace

from schemas.geometry import ConvexPieces, Pose
from schemas.objects import PlacedObject
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.aabb import size_around
from tableverse_factory.physics.bodies.materials import estimate_mass_kg, material_for, rolling_friction_m
from tableverse_factory.physics.mjcf.spec import SceneBody, scene_body


def prior_body(item: PlacedObject, pieces: ConvexPieces, pose: Pose) -> SceneBody:
    """The object at a pose, with the mass and the friction of its material.

    Raises:
        GeometryError: if no piece is thick enough to simulate.
    """
    try:
        body = scene_body(item.object_id, item.mesh, pieces.hulls, item.scale, 1.0, pose)
    except GeometryError as error:
        raise GeometryError(f"{item.object_id}: {error}") from error
    mass = estimate_mass_kg(item.label, body.properties.volume_m3, size_around(body.mesh.vertices))
    return with_friction_of(item.label, body.with_mass(mass))


def with_friction_of(label: str, body: SceneBody) -> SceneBody:
    """The body with the sliding and rolling friction of the material that its label suggests."""
    rolling = rolling_friction_m(label, size_around(body.mesh.vertices))
    return replace(body, friction=material_for(label).friction, rolling_friction=rolling)
