"""A scene of blocks and a motion by hand that picks one up and puts it down elsewhere: no planner is needed."""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import mujoco
import numpy as np

from schemas.config import Config
from schemas.curation import Relation
from schemas.geometry import Pose
from schemas.outcome import Done
from schemas.scene import ExportedScene
from schemas.trajectories import Motion
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.execution.goal import Goal, load_goal
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.robotics.robots.station import Station
from tableverse_factory.stages.export.export import export
from tests.helpers.simple_scenes import Solid, as_settled, box, curated, layout

BASE = Pose(np.array([0.0, -0.5, 0.0]), np.array([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]))
BLOCK, REFERENCE, BYSTANDER = "obj_000", "obj_001", "obj_002"
START, BESIDE = (0.0, 0.0, 0.03), (0.08, 0.1, 0.03)
STEP_S = 0.02
WIDTH_M = 0.04


@lru_cache(maxsize=4)
def exported(bystander: tuple[float, float, float] = (-0.25, 0.15, 0.05)) -> ExportedScene:
    solids = [
        Solid(box(WIDTH_M, WIDTH_M, 0.06), START),
        Solid(box(0.08, 0.08, 0.04), (0.18, 0.1, 0.02)),
        Solid(box(0.03, 0.03, 0.1), bystander),
    ]
    outcome = export(curated(as_settled(layout(solids))), Config(), np.random.default_rng(0), Services(Path("unused")))
    assert isinstance(outcome, Done)
    return outcome.value


def scene_files(bystander: tuple[float, float, float] = (-0.25, 0.15, 0.05)) -> dict[str, bytes]:
    return dict(exported(bystander).files)


@lru_cache(maxsize=4)
def station(bystander: tuple[float, float, float] = (-0.25, 0.15, 0.05)) -> Station:
    return Station(scene_files(bystander), load_arm("panda"), BASE)


def goal(relation: Relation = Relation.NEXT_TO) -> Goal:
    return load_goal(scene_files(), {"relation": relation.value, "x_id": BLOCK, "y_id": REFERENCE}, 0.02)


@dataclass(frozen=True)
class Stop:
    """A pose of the gripper from above, how long it takes to get there, and what it does with its fingers there."""

    point: tuple[float, float, float]
    opening: float
    phase: int
    seconds: float


def pick_and_place(
    place: tuple[float, float, float] = BESIDE, closed: float = 0.0, over: tuple[float, float, float] | None = None
) -> Motion:
    """From above the block's start to `place`, by way of a point `over` which the arm passes low, where given."""
    wide = 0.07
    (x, y, z), (u, v, w) = START, place
    stops = [
        Stop((x, y, z + 0.1), wide, 0, 0.02),
        Stop((x, y, z), wide, 1, 1.0),
        Stop((x, y, z), closed, 1, 0.5),
        Stop((x, y, z + 0.16), closed, 2, 1.0),
        *([Stop(over, closed, 3, 1.2)] if over else []),
        Stop((u, v, w + 0.16), closed, 3, 1.2),
        Stop((u, v, w + 0.004), closed, 4, 1.0),
        Stop((u, v, w + 0.004), wide, 4, 0.5),
        Stop((u, v, w + 0.1), wide, 5, 0.8),
    ]
    joints = [_reach(stops[0].point, np.array(load_arm("panda").home))]
    for stop in stops[1:]:
        joints.append(_reach(stop.point, joints[-1]))
    positions, openings, phases = [joints[0][None]], [np.array([wide])], [np.array([0])]
    for k, stop in enumerate(stops[1:], start=1):
        share = np.arange(1, round(stop.seconds / STEP_S) + 1) * STEP_S / stop.seconds
        smooth = 10 * share**3 - 15 * share**4 + 6 * share**5
        positions.append(joints[k - 1] + smooth[:, None] * (joints[k] - joints[k - 1]))
        openings.append(stops[k - 1].opening + np.minimum(3 * share, 1.0) * (stop.opening - stops[k - 1].opening))
        phases.append(np.full(len(share), stop.phase))
    path = np.concatenate(positions)
    return Motion(
        STEP_S,
        path,
        np.gradient(path, STEP_S, axis=0),
        np.concatenate(openings),
        np.concatenate(phases).astype(np.int32),
    )


def _reach(point: tuple[float, float, float], guess: np.ndarray) -> np.ndarray:
    """Joints with the gripper at a point, pointing down and closing along x; damped least squares."""
    here = station()
    data, joints = here.data(), guess.copy()
    down = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    for _ in range(200):
        here.set_arm(data, joints, 0.04)
        mujoco.mj_kinematics(here.model, data)
        mujoco.mj_comPos(here.model, data)
        away = np.array(point) - data.site_xpos[here.tcp_site]
        now = data.site_xmat[here.tcp_site].reshape(3, 3)
        turn = 0.5 * sum(np.cross(now[:, k], down[:, k]) for k in range(3))
        jacobian = np.zeros((6, here.model.nv))
        mujoco.mj_jacSite(here.model, data, jacobian[:3], jacobian[3:], here.tcp_site)
        J = jacobian[:, here.joint_dof]
        error = np.concatenate([away, turn])
        joints = joints + J.T @ np.linalg.solve(J @ J.T + 1e-6 * np.eye(6), error)
    assert np.abs(error).max() < 1e-6, error
    return joints
