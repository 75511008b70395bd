"""Rollout of commands in MuJoCo by position control alone, without welds or teleported bodies.

The scene starts as exported, the arm at the motion's first sample. Between samples every servo's target moves in a
straight line, as a real controller interpolates its input; the gripper is commanded by its opening. After the last
sample the targets stand still.
"""

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float64, Int32

from schemas.geometry import Frozen, Pose
from schemas.trajectories import Motion, Phase
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.physics.simulate.at_rest import allow_sleep
from tableverse_factory.robotics.execution.monitor import ExecutionMonitor, StateSample
from tableverse_factory.robotics.robots.station import Station

# Speed below which an object may sleep: MuJoCo's default, 1e-3, freezes objects that have just lost their support
SLEEP_TOLERANCE = 1e-4
MIN_TIMESTEP_S = 1e-4
MAX_ITERATIONS = 1000  # limit for each of MuJoCo's solvers, so that any scene is simulated in bounded time
_SOLVERS = ("iterations", "ls_iterations", "noslip_iterations", "ccd_iterations", "sdf_iterations")


@dataclass(frozen=True, slots=True, eq=False)
class ServoCommands(Frozen):
    """Targets of the servos."""

    step_s: float  # between samples
    targets: Float64[np.ndarray, "t k"]  # of the joints [rad], and the opening of the gripper [m]; k = j + 1
    phases: Int32[np.ndarray, " t"]  # index into `Phase` of each sample, ascending

    def __len__(self) -> int:
        return len(self.targets)

    def last_of(self, phase: Phase) -> int:
        """Return the sample with which a phase ends, or -1."""
        own = np.flatnonzero(self.phases == list(Phase).index(phase))
        return int(own[-1]) if len(own) else -1


def build_commands(motion: Motion) -> ServoCommands:
    """Build the commands of a motion."""
    return ServoCommands(motion.step_s, np.column_stack([motion.positions, motion.openings]), motion.phases)


class Rollout:
    """Commands in execution on a station; `others` are the uncarried objects, in the order of the model."""

    def __init__(self, station: Station, base: Pose, commands: ServoCommands, x_id: str, y_id: str) -> None:
        """Place the base at a pose in the table frame; `x_id` is the carried object, `y_id` the reference."""
        check_simulation_settings(station.model)
        if absent := [name for name in (x_id, y_id) if name not in station.object_bodies]:
            raise InputError(f"the scene has no object {sanitize_line(absent[0], 100)!r}", "bad_arrays")
        if commands.targets.shape[1] != (joints := len(station.joint_qpos)) + 1:
            found = commands.targets.shape[1] - 1
            raise InputError(f"commands for {found} joints, but {station.arm.name} has {joints}", "bad_arrays")
        station.place_base(base)
        self.commands = commands
        self._monitor = ExecutionMonitor(station, x_id)
        self.others = self._monitor.others
        self._station, self._model = station, station.model

    def samples(self, more: int = 0) -> Generator[StateSample]:
        """Simulate lazily, a sample at a time, repeating the last command `more` times."""
        data = self._start()
        self._monitor.begin(data)
        yield self._sample(data, 0)
        with align_timestep(self._model, self.commands.step_s) as steps:
            shares = np.arange(1, steps + 1)[:, None] / steps
            for index in range(1, len(self.commands) + more):
                before, now = self._target(index - 1), self._target(index)
                for target in before + shares * (now - before):
                    self._station.control(data, target)
                    mujoco.mj_step(self._model, data)
                yield self._sample(data, index)

    def find_touching(self, object_id: str) -> tuple[str, ...]:
        """Find the other objects that initially touch an object."""
        return self._monitor.find_touching(self._start(), object_id)

    def _start(self) -> mujoco.MjData:
        data, first = self._station.data(), self.commands.targets[0]
        self._station.set_arm(data, first[:-1], float(first[-1]))
        self._station.control(data, first)
        mujoco.mj_forward(self._model, data)
        return data

    def _target(self, index: int) -> Float64[np.ndarray, " k"]:
        return self.commands.targets[min(index, len(self.commands) - 1)]

    def _sample(self, data: mujoco.MjData, index: int) -> StateSample:
        phase = int(self.commands.phases[min(index, len(self.commands) - 1)])
        return self._monitor.sample(data, index, phase, self._target(index))


@contextmanager
def align_timestep(model: mujoco.MjModel, step_s: float) -> Iterator[int]:
    """Yield the number of steps per sample; inside, the timestep divides the sample's step.

    Resting objects without moving contacts sleep, which saves most of the work in a full scene.
    """
    own = float(model.opt.timestep)
    steps = max(1, int(np.ceil(step_s / own - 1e-6)))
    model.opt.timestep = step_s / steps
    try:
        with allow_sleep(model, SLEEP_TOLERANCE):
            yield steps
    finally:
        model.opt.timestep = own


def check_simulation_settings(model: mujoco.MjModel) -> None:
    """Refuse a scene of any origin whose own settings would make its simulation endless."""
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
