"""Exported scenes of blocks at known places, and how to bring the gripper somewhere."""

from collections.abc import Sequence

import mujoco
import numpy as np

from schemas.geometry import Pose
from schemas.objects import Table
from tableverse_factory.physics.mjcf.slab import fit_slab
from tableverse_factory.physics.mjcf.spec import make_scene_body, make_scene_files
from tableverse_factory.robotics.robots.station import Station
from tests.helpers.simple_scenes import TABLE, UPRIGHT, box

WIDE_TABLE = Table(np.zeros(2), np.array([0.7, 0.7]), 0.0, (150, 120, 90), 0.0)
DOWN = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
"""The gripper frame, in the table frame: it points down and closes along x."""


def block_files(
    blocks: Sequence[tuple[tuple[float, float, float], tuple[float, float]]],
    mass_kg: float = 0.5,
    table: Table = TABLE,
    names: Sequence[str] = (),
) -> dict[str, bytes]:
    """Files of a scene with blocks of these sizes that stand at these x and y [m]."""
    bodies = []
    for index, (size, (x, y)) in enumerate(blocks):
        mesh, pose = box(*size), Pose(np.array([x, y, size[2] / 2]), UPRIGHT)
        name = names[index] if names else f"obj_{index:03d}"
        bodies.append(make_scene_body(name, mesh, (mesh,), 1.0, mass_kg, pose))
    files = make_scene_files(bodies, fit_slab(table, [], [], []))
    return {"scene.xml": files.xml.encode(), **files.assets}


def reached(station: Station, position: Sequence[float], start: np.ndarray) -> np.ndarray:
    """Joints with the gripper `DOWN` at a position, by Newton's method from a start that is not far."""
    model, data, joints = station.model, station.data(), start.copy()
    jacobian = np.zeros((6, model.nv))
    for _ in range(100):
        station.set_arm(data, joints, 0.08)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        now = data.site_xmat[station.tcp_site].reshape(3, 3)
        turn = 0.5 * np.cross(now.T, DOWN.T).sum(axis=0)
        error = np.concatenate([np.array(position) - data.site_xpos[station.tcp_site], turn])
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], station.tcp_site)
        own = jacobian[:, station.joint_dof]
        joints = joints + own.T @ np.linalg.solve(own @ own.T + 1e-4 * np.eye(6), error)
    assert np.linalg.norm(error) < 1e-5
    assert (joints > station.arm.lower).all()
    assert (joints < station.arm.upper).all()
    return joints


class Mover:
    """Sends commands to a station, rest to rest."""

    def __init__(self, station: Station) -> None:
        self.station, self.data = station, station.data()
        self.joints, self.opening = np.array(station.arm.home), station.arm.max_opening_m

    def go(self, joints: np.ndarray, opening: float, seconds: float) -> np.ndarray:
        """Moves smoothly; returns joints commanded and had, at every step. Shape (t, 2, j)."""
        steps = round(seconds / self.station.model.opt.timestep)
        rows = []
        for step in range(1, steps + 1):
            share = step / steps
            smooth = share**3 * (10 - 15 * share + 6 * share**2)
            target = self.joints + smooth * (joints - self.joints)
            width = self.opening + share * (opening - self.opening)
            self.station.control(self.data, np.array([*target, width]))
            mujoco.mj_step(self.station.model, self.data)
            rows.append([target, self.data.qpos[self.station.joint_qpos]])
        self.joints, self.opening = np.array(joints), opening
        return np.array(rows)
