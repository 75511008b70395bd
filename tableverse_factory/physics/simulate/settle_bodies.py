"""Bring bodies to rest on the table; restless ones get more rolling friction."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from schemas.geometry import Pose
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.mesh.meshes import box_center
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.mjcf.spec import SceneBody, make_simulation_spec, quantize_pose
from tableverse_factory.physics.simulate.at_rest import Rest, simulate_to_rest

# For a body that rocks forever on the rounded edge of a piece, kicked by contacts that jump between its ends. It is
# written in the XML and in meta.json of the bodies that needed it.
STEADIER_ROLLING_FRICTION = 0.02


def bring_to_rest(
    bodies: Sequence[SceneBody], slab: Slab, *, timestep_s: float, max_time_s: float, gentle: bool
) -> tuple[tuple[SceneBody, ...], Rest]:
    """Simulate to rest; where `max_time_s` is up before, again with more rolling friction for the restless bodies.

    Returns the bodies where they ended, in their order, and the outcome of the last try, with the time of both.
    """
    ended, rest = simulate_bodies(bodies, slab, timestep_s, max_time_s, gentle)
    if rest.at_rest or rest.warnings or find_fallen(ended, slab):
        return ended, rest
    restless = {body.object_id for body, moving in zip(ended, rest.moving, strict=True) if moving}
    steady = increase_rolling_friction(ended, restless)
    ended, again = simulate_bodies(steady, slab, timestep_s, max_time_s, gentle=False)
    return ended, replace(again, time_s=rest.time_s + again.time_s)


def increase_rolling_friction(bodies: Sequence[SceneBody], restless: set[str]) -> tuple[SceneBody, ...]:
    """Give the named bodies `STEADIER_ROLLING_FRICTION`."""
    steady = STEADIER_ROLLING_FRICTION
    return tuple(replace(b, rolling_friction=steady) if b.object_id in restless else b for b in bodies)


def move_bodies(bodies: Sequence[SceneBody], poses: Sequence[Pose]) -> tuple[SceneBody, ...]:
    """Move bodies to poses, rounded as in the XML: tables, meta.json and XML then agree to the last digit."""
    return tuple(replace(body, pose=quantize_pose(pose)) for body, pose in zip(bodies, poses, strict=True))


def find_fallen(bodies: Sequence[SceneBody], slab: Slab) -> list[str]:
    """Find the objects whose box centre is below the table top or beyond its edge."""
    if not bodies:
        return []
    centers = np.concatenate([transform_points(body.pose, box_center(body.mesh)[None]) for body in bodies])
    off = ~slab.holds(centers) | (centers[:, 2] < 0.0)
    return [body.object_id for body, gone in zip(bodies, off, strict=True) if gone]


def simulate_bodies(
    bodies: Sequence[SceneBody], slab: Slab, timestep_s: float, max_time_s: float, gentle: bool
) -> tuple[tuple[SceneBody, ...], Rest]:
    """Simulate once, until `max_time_s` is up; returns the bodies where they ended."""
    spec = make_simulation_spec(bodies, slab, timestep_s)
    rest = simulate_to_rest(spec.compile(), max_time_s, gentle)
    return move_bodies(bodies, rest.poses), rest
