"""Certificate of a scene: penetration, drift and rest, measured on its files alone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import compress

import mujoco
import numpy as np

from schemas.geometry import Pose
from schemas.scene import Certificate
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.geometry.mesh.meshes import box_center, place_mesh
from tableverse_factory.geometry.relations.containers import make_hollow_vessel
from tableverse_factory.physics.mjcf.geom_meshes import name_body
from tableverse_factory.physics.mjcf.pose_history import PoseHistory
from tableverse_factory.physics.simulate.at_rest import find_free_bodies, measure_drift, read_body_poses, set_poses
from tableverse_factory.physics.simulate.model_solids import ModelBody, find_deepest_overlaps, load_bodies

DRIFT_TIME_S = 5.0
DRIFT_LIMIT_M = 0.001
DRIFT_LIMIT_RAD = float(np.deg2rad(1.0))
FALL_M = 0.05  # an object whose centre of mass sinks this far within the drift time has fallen off its support

Depth = tuple[float, str]  # depth of the deepest pair [m], and its names joined by ` & `; (0.0, "") where none touch


@dataclass(frozen=True, slots=True)
class Measurement:
    """Measurements of a MuJoCo model and its free bodies, by name.

    Attributes:
        pieces: Deepest contact between geoms in the initial state.
        meshes: Deepest shared volume between visible meshes in the initial state.
        drift_m: Largest displacement of a centre of mass over `DRIFT_TIME_S` [m].
        moved: Bodies beyond the limits of drift.
        fell: Bodies that sank by more than `FALL_M`.
        repaired: Geoms whose mesh had to be closed for the measurement, and how.
        end_poses: Where the bodies are after the drift time.
    """

    bodies: tuple[str, ...]
    pieces: Depth
    meshes: Depth
    drift_m: float
    drift_rad: float
    moved: tuple[str, ...]
    fell: tuple[str, ...]
    warnings: tuple[str, ...]
    repaired: tuple[str, ...]
    end_poses: tuple[Pose, ...]

    @property
    def at_rest(self) -> bool:
        """Whether no body moved beyond the limits or fell, and the simulation was stable."""
        return not (self.moved or self.fell or self.warnings)

    def colliding(self, epsilon_m: float) -> bool:
        """Whether any pair is deeper than this."""
        return max(self.pieces[0], self.meshes[0]) > epsilon_m


def measure_model(model: mujoco.MjModel) -> Measurement:
    """Measure the initial state of any model: its free bodies against one another and the static geometry."""
    return _measure(model, *load_bodies(model))


def certify(model: mujoco.MjModel, history: PoseHistory, epsilon_m: float) -> tuple[Certificate, Measurement]:
    """Certify an exported scene from its compiled files; a touch less deep than `epsilon_m` [m] is no collision."""
    moving, still = load_bodies(model)
    now = _measure(model, moving, still)
    poses = read_body_poses(model, mujoco.MjData(model), find_free_bodies(model))
    before = [history.rectified.get(thing.name, pose) for thing, pose in zip(moving, poses, strict=True)]
    shift = {}
    for thing, pose in zip(moving, poses, strict=True):
        if placed := history.placed.get(thing.name):
            center = box_center(thing.mesh)[None]
            moved = transform_points(pose, center) - transform_points(placed, center)
            shift[thing.name] = float(np.linalg.norm(moved))
    certificate = Certificate(
        epsilon_m=epsilon_m,
        piece_penetration_before_m=find_deepest_contact(model, before)[0],
        mesh_penetration_before_m=_find_deepest_overlap(moving, before, still)[0],
        piece_penetration_m=now.pieces[0],
        mesh_penetration_m=now.meshes[0],
        drift_m=now.drift_m,
        drift_rad=now.drift_rad,
        displacement_m=tuple(sorted(shift.items())),
        fell=now.fell,
        left_container=_find_spilled(moving, poses, history.contained_in),
        at_rest=now.at_rest,
        colliding=now.colliding(epsilon_m),
    )
    return certificate, now


def _measure(model: mujoco.MjModel, moving: Sequence[ModelBody], still: ModelBody) -> Measurement:
    names = tuple(thing.name for thing in moving)
    poses = read_body_poses(model, mujoco.MjData(model), find_free_bodies(model))
    drift = measure_drift(model, DRIFT_TIME_S)
    too_far = (drift.distance_m > DRIFT_LIMIT_M) | (drift.angle_rad > DRIFT_LIMIT_RAD)
    return Measurement(
        bodies=names,
        pieces=find_deepest_contact(model, poses),
        meshes=_find_deepest_overlap(moving, poses, still),
        drift_m=float(drift.distance_m.max(initial=0.0)),
        drift_rad=float(drift.angle_rad.max(initial=0.0)),
        moved=tuple(compress(names, too_far)),
        fell=tuple(compress(names, drift.sunk_m > FALL_M)),
        warnings=drift.warnings,
        repaired=tuple(note for thing in (*moving, still) for note in thing.repaired),
        end_poses=drift.poses,
    )


def find_deepest_contact(model: mujoco.MjModel, poses: Sequence[Pose]) -> Depth:
    """Find MuJoCo's deepest contact with the free bodies at these poses, static geometry included."""
    data = mujoco.MjData(model)
    set_poses(model, data, find_free_bodies(model), poses)
    mujoco.mj_fwdPosition(model, data)
    roots = model.body_rootid[model.geom_bodyid[data.contact.geom]]
    depths = np.where(roots[:, 0] != roots[:, 1], -data.contact.dist, 0.0)
    if depths.max(initial=0.0) <= 0.0:
        return 0.0, ""
    worst = int(np.argmax(depths))
    return float(depths[worst]), " & ".join(name_body(model, int(root)) for root in roots[worst])


def _find_deepest_overlap(moving: Sequence[ModelBody], poses: Sequence[Pose], still: ModelBody) -> Depth:
    found = ((depth, f"{a} & {b}") for a, b, depth in find_deepest_overlaps(moving, poses, still))
    return max(found, key=lambda overlap: overlap[0], default=(0.0, ""))


def _find_spilled(
    moving: Sequence[ModelBody], poses: Sequence[Pose], contained_in: Mapping[str, str]
) -> tuple[str, ...]:
    """Find the contents that no longer lie in their container, as all did after rectification."""
    placed = {thing.name: place_mesh(thing.mesh, pose) for thing, pose in zip(moving, poses, strict=True)}
    holders = {name: make_hollow_vessel(placed[name]) for name in sorted(set(contained_in.values()) & placed.keys())}
    return tuple(
        name
        for name, container in sorted(contained_in.items())
        if name in placed and container in holders and not holders[container].holds(placed[name])
    )
