"""A motion executed in MuJoCo: position control and nothing else; nothing is welded, nothing is moved by hand.

The scene starts as exported, the arm at the motion's first sample. From one sample to the next every servo's target
goes in a straight line, as a real controller interpolates what it is sent; the gripper is commanded by its opening.
After the last sample the targets stand still.
"""

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64, Int32

from schemas.geometry import Frozen, Pose, Vector3
from schemas.trajectories import Motion, Phase
from tableverse_factory.errors import InputError
from tableverse_factory.physics.rest import UNSTABLE
from tableverse_factory.robots.station import Station
from tableverse_factory.text import printable

_SLEEP = int(getattr(mujoco.mjtEnableBit, "mjENBL_SLEEP", 0))
"""Versions of MuJoCo that do not know it simulate what rests too."""

SLEEP_TOLERANCE = 1e-4
"""Speed below which a thing may fall asleep. MuJoCo's own, 1e-3, freezes what has lost its support and begins to
topple: its first ten steps are slower. With this one success and displacements were those of a rollout with everything
awake, in all trajectories that were measured (docs/trajectories.md)."""

MIN_TIMESTEP_S = 1e-4
MAX_ITERATIONS = 1000
"""Of each of MuJoCo's solvers: a scene of any origin has to be simulated in bounded time."""

_SOLVERS = ("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations", "sdf_iterations")


@dataclass(frozen=True, slots=True, eq=False)
class Commands(Frozen):
    """What the servos are told.

    Attributes:
        step_s: Time between samples [s].
        targets: Of the joints [rad], and the opening of the gripper [m]. Shape (t, j + 1).
        phases: Index into `Phase` of each sample, ascending. Shape (t,).
    """

    step_s: float
    targets: Float64[np.ndarray, "t k"]
    phases: Int32[np.ndarray, " t"]

    def __len__(self) -> int:
        return len(self.targets)

    def last_of(self, phase: Phase) -> int:
        """The sample with which a phase ends; -1 where there is none of it."""
        own = np.flatnonzero(self.phases == list(Phase).index(phase))
        return int(own[-1]) if len(own) else -1


def commands_of(motion: Motion) -> Commands:
    """A motion as commands."""
    return Commands(motion.step_s, np.column_stack([motion.positions, motion.openings]), motion.phases)


@dataclass(slots=True, eq=False)
class Sample:
    """The state in which the targets have just reached a sample's command.

    Not frozen: there are hundreds of them in a rollout, and none leaves it.

    Attributes:
        index: Of the sample; where the last command is repeated, it counts on.
        phase: Index into `Phase`.
        command: Targets of the joints and the opening. Shape (k,).
        qpos: Joints [rad] and fingers [m]. Shape (m,).
        qvel: Their speeds. Shape (m,).
        tcp: Gripper frame in the table frame: position, quaternion wxyz. Shape (7,).
        pose: The carried object's own frame in the table frame. Shape (7,).
        others: The same of each other object, in the order of `Execution.others`. Shape (n, 7).
        center: The carried object's centre of mass [m].
        velocity: Of the object's frame [m/s], then its spin [rad/s]. Shape (6,).
        pads: Fingers that touch the object: 1 the first, 2 the second, 3 both.
        moved_m: How far each other object is from where it stood. Shape (n,) [m].
        heights_m: Of their centres of mass. Shape (n,) [m].
        arm_error_rad: Largest distance of a joint from its target.
        warnings: Names of MuJoCo's warnings that make all of it worthless.
    """

    index: int
    phase: int
    command: Float64[np.ndarray, " k"]
    qpos: Float64[np.ndarray, " m"]
    qvel: Float64[np.ndarray, " m"]
    tcp: Float64[np.ndarray, "7"]
    pose: Float64[np.ndarray, "7"]
    others: Float64[np.ndarray, "n 7"]
    center: Vector3
    velocity: Float64[np.ndarray, "6"]
    pads: int
    moved_m: Float64[np.ndarray, " n"]
    heights_m: Float64[np.ndarray, " n"]
    arm_error_rad: float
    warnings: tuple[str, ...]


class Execution:
    """Commands on their way through a station.

    Attributes:
        commands: As given.
        others: Ids of the objects that are not carried, in the order of the model.
    """

    def __init__(self, station: Station, base: Pose, commands: Commands, x_id: str, y_id: str) -> None:
        """Puts the base where it belongs; nothing moves yet.

        Args:
            station: Scene and arm.
            base: The robot's base in the table frame.
            commands: For its joints and gripper.
            x_id: Of the object that is carried.
            y_id: Of the reference.

        Raises:
            InputError: `bad_arrays` if the scene has no such objects, or the commands are not for this arm;
                `bad_scene` if the scene's own settings would make its simulation endless.
        """
        _check_settings(station.model)
        if absent := [name for name in (x_id, y_id) if name not in station.object_bodies]:
            raise InputError(f"the scene has no object {printable(absent[0], 100)!r}", "bad_arrays")
        if commands.targets.shape[1] != (joints := len(station.joint_qpos)) + 1:
            found = commands.targets.shape[1] - 1
            raise InputError(f"commands for {found} joints, but {station.arm.name} has {joints}", "bad_arrays")
        station.place_base(base)
        self.commands = commands
        self.others = tuple(name for name in station.object_ids if name != x_id)
        self._station, self._model = station, station.model
        self._body = station.object_bodies[x_id]
        self._pose, self._velocity = station.object_qpos[x_id], station.object_dof[x_id]
        self._qpos = np.concatenate([station.joint_qpos, station.finger_qpos])
        self._qvel = np.concatenate([station.joint_dof, station.finger_dof])
        self._other_poses = np.array([station.object_qpos[name] for name in self.others], dtype=np.intp)[:, None]
        self._other_bodies = np.array([station.object_bodies[name] for name in self.others], dtype=np.intp)
        self._finger_of, self._bodies = _finger_of_geom(station), np.array(station.model.geom_bodyid)

    def samples(self, more: int = 0) -> Generator[Sample]:
        """Simulates, a sample at a time, as long as somebody asks for the next.

        Args:
            more: How often the last command is repeated after the end.
        """
        data = self._start()
        spread = self._spread()
        start = (data.xipos[self._other_bodies].copy(), data.ximat[self._other_bodies].copy())
        yield self._sample(data, 0, start, spread)
        with self._options(self.commands.step_s) as steps:
            shares = np.arange(1, steps + 1)[:, None] / steps
            for index in range(1, len(self.commands) + more):
                before, now = self._target(index - 1), self._target(index)
                for target in before + shares * (now - before):
                    self._station.control(data, target)
                    mujoco.mj_step(self._model, data)
                yield self._sample(data, index, start, spread)

    def touching(self, object_id: str) -> tuple[str, ...]:
        """The other objects that touch one as the scene stands."""
        data, bodies = self._start(), self._model.geom_bodyid
        near = {frozenset((int(bodies[a]), int(bodies[b]))) for a, b in data.contact.geom[: data.ncon]}
        own = self._station.object_bodies[object_id]
        return tuple(name for name in self.others if frozenset((own, self._station.object_bodies[name])) in near)

    def _start(self) -> mujoco.MjData:
        data, first = self._station.data(), self.commands.targets[0]
        self._station.set_arm(data, first[:-1], float(first[-1]))
        self._station.control(data, first)
        mujoco.mj_forward(self._model, data)
        return data

    def _target(self, index: int) -> Float64[np.ndarray, " k"]:
        target: Float64[np.ndarray, " k"] = self.commands.targets[min(index, len(self.commands) - 1)]
        return target

    @contextmanager
    def _options(self, step_s: float) -> Iterator[int]:
        """How many steps a sample takes; the timestep is shortened, where needed, so that they end on the sample.

        What rests and is touched by nothing that moves sleeps: in a full scene that is most of the work.
        """
        option = self._model.opt
        own = float(option.timestep), int(option.enableflags)
        steps = max(1, int(np.ceil(step_s / own[0] - 1e-6)))
        option.timestep, option.enableflags = step_s / steps, own[1] | _SLEEP
        tolerance = float(option.sleep_tolerance) if _SLEEP else 0.0
        if _SLEEP:
            option.sleep_tolerance = SLEEP_TOLERANCE
        try:
            yield steps
        finally:
            option.timestep, option.enableflags = own
            if _SLEEP:
                option.sleep_tolerance = tolerance

    def _spread(self) -> Float64[np.ndarray, "n 3"]:
        """Mean square of the distance of each other body's matter from its centre, along its principal axes [m²]."""
        inertia, mass = self._model.body_inertia[self._other_bodies], self._model.body_mass[self._other_bodies]
        spread: Float64[np.ndarray, "n 3"] = (inertia.sum(axis=1, keepdims=True) / 2 - inertia) / mass[:, None]
        return spread

    def _sample(
        self,
        data: mujoco.MjData,
        index: int,
        start: tuple[Float64[np.ndarray, "n 3"], Float64[np.ndarray, "n 9"]],
        spread: Float64[np.ndarray, "n 3"],
    ) -> Sample:
        pads = self._pads(data)  # of the last step; what follows is where that step has led
        mujoco.mj_kinematics(self._model, data)
        centers, axes = data.xipos[self._other_bodies], data.ximat[self._other_bodies]
        turned = ((axes - start[1]).reshape(-1, 3, 3) ** 2).sum(axis=1)
        moved = np.sqrt(((centers - start[0]) ** 2).sum(axis=1) + (turned * spread).sum(axis=1))
        quaternion = np.empty(4)
        mujoco.mju_mat2Quat(quaternion, data.site_xmat[self._station.tcp_site])
        command = self._target(index)
        return Sample(
            index=index,
            phase=int(self.commands.phases[min(index, len(self.commands) - 1)]),
            command=command,
            qpos=data.qpos[self._qpos],
            qvel=data.qvel[self._qvel],
            tcp=np.concatenate([data.site_xpos[self._station.tcp_site], quaternion]),
            pose=data.qpos[self._pose : self._pose + 7].copy(),
            others=data.qpos[self._other_poses + np.arange(7)],
            center=data.xipos[self._body].copy(),
            velocity=data.qvel[self._velocity : self._velocity + 6].copy(),
            pads=pads,
            moved_m=moved,
            heights_m=centers[:, 2],
            arm_error_rad=float(np.abs(data.qpos[self._station.joint_qpos] - command[:-1]).max()),
            warnings=_warnings(data),
        )

    def _pads(self, data: mujoco.MjData) -> int:
        pairs = data.contact.geom
        fingers = self._finger_of[pairs]  # 0 where a geom is none of a finger
        mine = self._bodies[pairs[:, ::-1]] == self._body
        return int(np.bitwise_or.reduce(fingers[mine], initial=0))


def _check_settings(model: mujoco.MjModel) -> None:
    timestep = float(model.opt.timestep)
    if not timestep >= MIN_TIMESTEP_S:
        raise InputError(
            f"the scene's timestep is {timestep:g} s, and it is simulated in steps of at least {MIN_TIMESTEP_S:g} s",
            "bad_scene",
        )
    for name in _SOLVERS:
        if not 0 <= (found := int(getattr(model.opt, name))) <= MAX_ITERATIONS:
            raise InputError(
                f"the scene's option {name} is {found}, and at most {MAX_ITERATIONS} are made", "bad_scene"
            )


def _warnings(data: mujoco.MjData) -> tuple[str, ...]:
    if not data.warning.number.any():
        return ()
    return tuple(kind.name.removeprefix("mjWARN_").lower() for kind in UNSTABLE if data.warning[kind].number)


def _finger_of_geom(station: Station) -> Int32[np.ndarray, " g"]:
    """For each geom 1 or 2 where it grips and is of the first or second finger, else 0."""
    finger = np.zeros(station.model.ngeom, dtype=np.int32)
    bodies = station.model.geom_bodyid[station.finger_geoms]
    finger[station.finger_geoms] = np.where(bodies == bodies.min(), 1, 2)
    return finger
