"""SETTLE stage: a short forward simulation brings the rectified layout to rest (paper section 3.2, last step)."""

from collections.abc import Sequence

import numpy as np

from schemas.config import Config
from schemas.geometry import Pose
from schemas.identity import find_name_clashes
from schemas.objects import PlacedObject
from schemas.outcome import Done, Dropped, Outcome
from schemas.scene import RectifiedLayout, SettledScene
from tableverse_factory.core.errors import GeometryError
from tableverse_factory.models.services import Services
from tableverse_factory.physics.bodies.prior_mass import make_prior_body
from tableverse_factory.physics.mjcf.slab import Slab, fit_slab
from tableverse_factory.physics.mjcf.spec import SceneBody
from tableverse_factory.physics.simulate.at_rest import Rest
from tableverse_factory.physics.simulate.settle_bodies import find_fallen
from tableverse_factory.physics.simulate.settle_near import settle_near


def settle(
    layout: RectifiedLayout,
    config: Config,
    rng: np.random.Generator,  # noqa: ARG001
    services: Services,  # noqa: ARG001
) -> Outcome[SettledScene]:
    """Simulate until every object is at rest.

    Objects that end far from where they were seen are put down once more near there, unless the paper's method, which
    may move objects far, has rectified them. Masses are priors from labels and volumes: the judge predicts better ones
    next, and export settles again with those. Dropped: `reserved_object_id`, `unusable_mesh`, `simulation_unstable`,
    `object_fell`, `not_at_rest`.
    """
    objects = layout.placed.objects
    if bad := find_name_clashes([item.object_id for item in objects]):
        return Dropped("reserved_object_id", f"these ids cannot be bodies of one scene: {', '.join(bad[:5])}")
    try:
        bodies, slab = make_bodies(layout)
    except GeometryError as error:
        return Dropped("unusable_mesh", str(error))
    step, limit = config.settle.timestep_s, config.settle.max_time_s
    seen = {} if layout.method == "lccr" else list_seen_poses(objects)
    ended, rest = settle_near(bodies, seen, slab, timestep_s=step, max_time_s=limit)
    return _decide_outcome(layout, ended, slab, rest)


def make_bodies(layout: RectifiedLayout) -> tuple[tuple[SceneBody, ...], Slab]:
    """Make the bodies of a layout, with guessed mass and friction, and the table under them."""
    objects = layout.placed.objects
    bodies = tuple(map(make_prior_body, objects, layout.pieces, layout.poses))
    meshes, scales = [item.mesh for item in objects], [item.scale for item in objects]
    return bodies, fit_slab(layout.placed.table, meshes, layout.poses, scales)


def list_seen_poses(objects: Sequence[PlacedObject]) -> dict[str, Pose]:
    """List the poses that the picture gave, by id, but of contents and their containers, which were assembled."""
    containers = {item.contained_in for item in objects}
    free = (item for item in objects if item.contained_in is None and item.object_id not in containers)
    return {item.object_id: item.pose for item in free}


def _decide_outcome(
    layout: RectifiedLayout, bodies: Sequence[SceneBody], slab: Slab, rest: Rest
) -> Outcome[SettledScene]:
    if rest.warnings:
        return Dropped("simulation_unstable", f"MuJoCo warned of {', '.join(rest.warnings)} at {rest.time_s:.2f} s")
    if fell := find_fallen(bodies, slab):
        return Dropped("object_fell", f"{', '.join(fell[:10])} of {len(bodies)} objects left the table")
    if not rest.at_rest:
        named = zip(bodies, rest.speeds, rest.moving, strict=True)
        moving = [f"{body.object_id} {speed:.3f}" for body, speed, restless in named if restless]
        return Dropped("not_at_rest", f"after {rest.time_s:.1f} s still moving [m/s, rad/s]: {', '.join(moving[:10])}")
    return Done(SettledScene(layout.scene_id, layout, tuple(body.pose for body in bodies), rest.time_s))
