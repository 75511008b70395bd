"""A body before the judge has spoken: mass and friction as the label suggests."""

from dataclasses import replace

import numpy as np

from schemas.geometry import ConvexPieces, Pose
from schemas.objects import PlacedObject
from tableverse_factory.errors import GeometryError
from tableverse_factory.physics.materials import estimate_mass_kg, material_for
from tableverse_factory.physics.spec import SceneBody, scene_body


def prior_body(item: PlacedObject, pieces: ConvexPieces, pose: Pose) -> SceneBody:
    """The object at a pose, with the mass and the friction of its material.

    Raises:
        GeometryError: if no piece is thick enough to simulate.
    """
    try:
        body = scene_body(item.object_id, item.mesh, pieces.hulls, item.scale, 1.0, pose)
    except GeometryError as error:
        raise GeometryError(f"{item.object_id}: {error}") from error
    size = np.ptp(item.mesh.vertices, axis=0) * item.scale
    mass = estimate_mass_kg(item.label, body.properties.volume_m3, size)
    return replace(body.with_mass(mass), friction=material_for(item.label).friction)
