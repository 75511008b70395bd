"""Bodies with the prior mass and friction of their label."""

from dataclasses import replace

from schemas.geometry import ConvexPieces, Pose
from schemas.objects import PlacedObject
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.geometry.math.aabb import aabb_size
from tableverse_factory.physics.bodies.materials import estimate_mass_kg, estimate_rolling_friction_m, guess_material
from tableverse_factory.physics.mjcf.spec import SceneBody, make_scene_body


def make_prior_body(item: PlacedObject, pieces: ConvexPieces, pose: Pose) -> SceneBody:
    """Make the body of an object at a pose, with the mass and friction of its guessed material."""
    try:
        body = make_scene_body(item.object_id, item.mesh, pieces.hulls, item.scale, 1.0, pose)
    except GeometryError as error:
        raise GeometryError(f"{item.object_id}: {error}") from error
    mass = estimate_mass_kg(item.label, body.properties.volume_m3, aabb_size(body.mesh.vertices))
    return apply_material_friction(item.label, body.with_mass(mass))


def apply_material_friction(label: str, body: SceneBody) -> SceneBody:
    """Set the sliding and rolling friction of the material that the label suggests."""
    rolling = estimate_rolling_friction_m(label, aabb_size(body.mesh.vertices))
    return replace(body, friction=guess_material(label).friction, rolling_friction=rolling)
