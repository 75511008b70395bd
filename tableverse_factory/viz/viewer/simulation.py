"""Interactive simulation of one scene: reset, push, real-time stepping, contacts."""

import time
from collections.abc import Container, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from schemas.geometry import Frozen, Points, Pose, Vector3
from schemas.trajectories import Numbers
from tableverse_factory.physics.mjcf.geom_meshes import name_body
from tableverse_factory.physics.simulate.at_rest import UNSTABLE, find_free_bodies, make_quiet_data, read_body_poses

MAX_CONTACTS = 1000  # most contacts shown, the strongest first

SHORTEST_M, LONGEST_M, METRES_PER_NEWTON = 0.015, 0.1, 0.03  # limits and scale of the length of a force arrow


@dataclass(frozen=True, slots=True, eq=False)
class Contacts(Frozen):
    """Contacts of a scene, the strongest first."""

    points: Points  # positions in the table frame, shape (n, 3) [m]
    normals: Points  # unit vectors from the first body to the second, shape (n, 3)
    forces_n: Numbers  # along the normals, shape (n,) [N]
    depths_m: Numbers  # overlaps; negative for a gap, shape (n,) [m]
    total: int  # those beyond `MAX_CONTACTS` included

    def __len__(self) -> int:
        return len(self.forces_n)

    def compute_arrows(self) -> np.ndarray:
        """Compute start and end of an arrow per contact, its length by the force. Shape (n, 2, 3) [m]."""
        lengths = np.clip(METRES_PER_NEWTON * self.forces_n, SHORTEST_M, LONGEST_M)
        return np.stack([self.points, self.points + lengths[:, None] * self.normals], axis=1)


class Simulation:
    """A state of a model whose moving bodies have free joints; other sessions share the model."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model, self._data = model, make_quiet_data(model)
        bodies = find_free_bodies(model)
        self._bodies = {name_body(model, body): body for body in bodies}
        mujoco.mj_forward(model, self._data)

    @property
    def time_s(self) -> float:
        """Simulated time since the last reset [s]."""
        return float(self._data.time)

    @property
    def unstable(self) -> bool:
        """Whether MuJoCo has reported an instability, after which its state is meaningless."""
        return any(self._data.warning[kind].number for kind in UNSTABLE)

    def reset(self, poses: Mapping[str, Pose]) -> None:
        """Reset to poses at rest; other objects return to their exported poses."""
        mujoco.mj_resetData(self._model, self._data)
        for name, pose in poses.items():
            if name in self._bodies:
                start = int(self._model.jnt_qposadr[self._model.body_jntadr[self._bodies[name]]])
                self._data.qpos[start : start + 3] = pose.position
                self._data.qpos[start + 3 : start + 7] = pose.quaternion_wxyz
        mujoco.mj_forward(self._model, self._data)

    def advance(self, seconds: float, budget_s: float = float("inf")) -> float:
        """Step until the simulated time is reached; return the simulated time that passed [s].

        `budget_s` is wall time: a heavy scene plays slower instead of delaying the others [s].
        """
        steps, until, done = round(seconds / self._model.opt.timestep), time.perf_counter() + budget_s, 0
        while done < steps and time.perf_counter() < until and not self.unstable:
            mujoco.mj_step(self._model, self._data)
            done += 1
        return done * float(self._model.opt.timestep)

    def push(self, name: str, impulse_ns: Vector3) -> None:
        """Change the linear momentum of an object by an impulse in the table frame [N s]; unknown names are ignored."""
        if name in self._bodies:
            body = self._bodies[name]
            start = int(self._model.body_dofadr[body])
            self._data.qvel[start : start + 3] += impulse_ns / max(float(self._model.body_subtreemass[body]), 1e-6)

    def poses(self) -> dict[str, Pose]:
        """Read the poses of all objects by name."""
        return dict(
            zip(self._bodies, read_body_poses(self._model, self._data, list(self._bodies.values())), strict=True)
        )

    def contacts(self, shown: Container[str] | None = None) -> Contacts:
        """Measure the contacts of the current state, of the `shown` objects only; None for all."""
        mujoco.mj_forward(self._model, self._data)
        contact, force = self._data.contact, np.zeros(6)
        hidden = [body for name, body in self._bodies.items() if shown is not None and name not in shown]
        bodies = self._model.body_rootid[self._model.geom_bodyid[np.array(contact.geom, dtype=int).reshape(-1, 2)]]
        kept = np.flatnonzero(~np.isin(bodies, hidden).any(axis=1))
        forces = np.zeros(len(kept))
        for place, index in enumerate(kept):
            mujoco.mj_contactForce(self._model, self._data, int(index), force)
            forces[place] = force[0]
        strongest = np.argsort(-forces, kind="stable")[:MAX_CONTACTS]
        chosen = kept[strongest]
        return Contacts(
            np.array(contact.pos)[chosen].reshape(-1, 3),
            np.array(contact.frame)[chosen, :3].reshape(-1, 3),
            forces[strongest],
            -np.array(contact.dist)[chosen],
            len(kept),
        )
