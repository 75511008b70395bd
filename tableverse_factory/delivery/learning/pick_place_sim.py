"""Interactive pick-and-place simulation of a scene, a task and an arm, one command at a time.

Success is defined as in trajectories/ (`execution.success`): lifted, nothing else moved too far, released, at rest, and
the relation holds on the true meshes. Only the six phases of the fingers are not required.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import mujoco
import numpy as np

from schemas.geometry import Frozen, Pose, TriangleMesh, Vector3
from schemas.trajectories import Numbers
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.dataset.scene_meta import read_object_names, read_object_phrases
from tableverse_factory.delivery.episodes.instructions import read_instruction, write_instruction
from tableverse_factory.delivery.episodes.observation import order_objects
from tableverse_factory.delivery.episodes.subtasks import SUBTASKS, estimate_phase
from tableverse_factory.delivery.learning.reward import compute_goal_distance, compute_progress
from tableverse_factory.delivery.learning.variation import Variation, displace_objects, vary_friction
from tableverse_factory.geometry.math.transforms import quaternion_about_z
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.physics.simulate.at_rest import HOLD_S, SPEED_LIMIT
from tableverse_factory.robotics.execution.arrays import MAX_STEP_S, MIN_STEP_S
from tableverse_factory.robotics.execution.goal import load_goal
from tableverse_factory.robotics.execution.monitor import ExecutionMonitor, StateSample
from tableverse_factory.robotics.execution.poses import pose_from_row
from tableverse_factory.robotics.execution.rollout import align_timestep, check_simulation_settings
from tableverse_factory.robotics.execution.success import FALL_M, MIN_LIFT_M, compute_displacement_limits
from tableverse_factory.robotics.robots.base import find_bases
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.robotics.robots.station import Station

TASK_KEYS = ("x_id", "y_id", "relation", "instruction")  # of a task of one's own
_UNMOVED_M = 1e-4  # displacement below which a relation is not recomputed


@dataclass(frozen=True, slots=True, eq=False)
class SimState(Frozen):
    """State after a command."""

    sample: StateSample
    lifted: bool  # by the fingers, now or before
    at_rest: bool  # for the last `HOLD_S`
    success: bool
    failure: str  # `disturbed`, `fell` or `simulation_unstable` once it cannot succeed any more; else empty
    progress: float  # from 0 to 1 (`learning.reward`)
    subtask: str  # estimated from the state; named as the phases of recordings
    disturbed_m: float  # largest displacement of any other object so far [m]


class PickPlaceSim:
    """Simulation of one arm, scene and task; `instruction` is foreign text, made printable."""

    def __init__(
        self,
        scene: Scene,
        task: str | Mapping[str, Any],
        robot: str = "panda",
        base: Pose | None = None,
        step_s: float = 0.02,
        max_disturbed_m: float = 0.02,
    ) -> None:
        """Compile the scene with its arm.

        Args:
            scene: Of a dataset.
            task: Id of one of its tasks, or one of your own: `x_id`, `y_id`, `relation` and, if you like,
                `instruction`; without one it is worded as those of the factory.
            robot: As in `robots.registry.load_arm`.
            base: Pose of the arm's base in the table frame; by default that of the task's recorded trajectory, else the
                best one from which both objects are reached (`no_base` if there is none).
            step_s: Time between commands [s].
            max_disturbed_m: Allowed displacement of any other object (`execution.success`) [m].
        """
        if not MIN_STEP_S <= step_s <= MAX_STEP_S:
            raise InputError(f"step_s {step_s}: give {MIN_STEP_S} to {MAX_STEP_S} s", "bad_step")
        if not max_disturbed_m >= 0.0:
            raise ConfigError(f"max_disturbed_m {max_disturbed_m}: give a length from 0 m on")
        files, row = scene.files(), _find_task(scene, task)
        self.goal = load_goal(files, row, max_disturbed_m)
        self.instruction = read_instruction(row) or self._write_instruction(scene)
        self.step_s = step_s
        self.station = Station(files, load_arm(robot))
        check_simulation_settings(self.station.model)
        if absent := [name for name in (self.goal.x_id, self.goal.y_id) if name not in self.station.object_bodies]:
            raise InputError(f"object {absent[0]!r} of scene {scene.scene_id} does not move", "bad_task")
        self.station.place_base(base or self._find_recorded_base(scene, row) or self._find_best_base())
        self._monitor = ExecutionMonitor(self.station, self.goal.x_id)
        self._friction = self.station.model.geom_friction.copy()
        self.reset(np.random.default_rng(0), Variation())

    @property
    def object_ids(self) -> tuple[str, ...]:
        """X, Y, then all others in the order of the model."""
        return order_objects(self.station.object_ids, self.goal.x_id, self.goal.y_id)

    def poses(self) -> np.ndarray:
        """Return position [m] and quaternion wxyz of each of `object_ids` in the table frame. Shape (n, 7)."""
        starts = np.array([self.station.object_qpos[name] for name in self.object_ids])
        return np.array(self._data.qpos[starts[:, None] + np.arange(7)])

    def reset(self, rng: np.random.Generator, variation: Variation) -> SimState:
        """Restore the exported scene, varied by `variation`, with the arm at home and open fingers."""
        self.station.model.geom_friction[:] = self._friction
        self._data = self.station.data()
        displace_objects(self.station, self._data, variation, rng)
        vary_friction(self.station, self.goal.x_id, variation, rng)
        mujoco.mj_forward(self.station.model, self._data)
        self._allowed_m = compute_displacement_limits(
            self.goal, self._monitor.others, self._monitor.find_touching(self._data, self.goal.y_id)
        )
        self._monitor.begin(self._data)
        self._command = np.array([*self.station.arm.home, self.station.arm.max_opening_m])
        self._index, self._still_s, self._disturbed_m, self._lifted = 0, 0.0, 0.0, False
        self._failure, self._relation_cache = "", (np.full((2, 7), np.inf), False)
        sample = self._monitor.sample(self._data, 0, 0, self._command)
        self._boxes = [
            _compute_box(place_mesh(mesh, pose_from_row(row)))
            for mesh, row in zip((self.goal.x, self.goal.y), self.poses()[:2], strict=True)
        ]
        self._stood = sample.center.copy()
        return self._update_state(sample)

    def step(self, command: Numbers) -> SimState:
        """Simulate until the servos' targets have moved in straight lines to a command.

        A command holds targets of the joints [rad], then the opening [m], clipped to the arm's limits. Shape (j + 1,).
        """
        arm = self.station.arm
        target = np.clip(command, [*arm.lower, 0.0], [*arm.upper, arm.max_opening_m])
        with align_timestep(self.station.model, self.step_s) as steps:
            for share in np.arange(1, steps + 1) / steps:
                self.station.control(self._data, self._command + share * (target - self._command))
                mujoco.mj_step(self.station.model, self._data)
            self._command, self._index = target, self._index + 1
            sample = self._monitor.sample(self._data, self._index, 0, target)
        return self._update_state(sample)

    def _update_state(self, sample: StateSample) -> SimState:
        moved = sample.center - self._stood
        rise = float(moved[2])
        self._lifted = self._lifted or (rise >= MIN_LIFT_M and sample.pads > 0)
        self._disturbed_m = max(self._disturbed_m, float(sample.moved_m.max(initial=0.0)))
        slow = bool(np.abs(sample.velocity).max() < SPEED_LIMIT)
        self._still_s = self._still_s + self.step_s if slow else 0.0
        self._failure = self._failure or self._check_simulation(sample)
        at_rest = self._still_s >= HOLD_S - 1e-9
        done = self._lifted and at_rest and not sample.pads and not self._failure and self._holds(sample)
        fingers, ways = sample.pads.bit_count(), self._measure_ways(sample)
        progress = compute_progress(self._lifted, fingers, *ways)
        way_m, speed = (float(np.hypot(*vector[:2])) for vector in (moved, sample.velocity))
        subtask = SUBTASKS[estimate_phase(self._lifted, fingers, ways[0], rise, way_m, speed)]
        return SimState(sample, self._lifted, at_rest, done, self._failure, progress, subtask, self._disturbed_m)

    def _measure_ways(self, sample: StateSample) -> tuple[float, float]:
        """Measure how far the gripper is from the object, and that from its goal [m]."""
        (_, x_half), (y, y_half) = self._boxes
        way_m = compute_goal_distance(self.goal.relation, sample.center, y, x_half, y_half)
        return float(np.linalg.norm(sample.tcp[:3] - sample.center)), way_m

    def _check_simulation(self, sample: StateSample) -> str:
        if sample.warnings:
            return "simulation_unstable"
        if min(float(sample.center[2]), float(sample.heights_m.min(initial=0.0))) < -FALL_M:
            return "fell"
        return "disturbed" if (sample.moved_m > self._allowed_m).any() else ""

    def _holds(self, sample: StateSample) -> bool:
        """Test whether the relation holds on the true meshes, cached while the objects stay."""
        now = np.array([sample.pose, sample.others[self._monitor.others.index(self.goal.y_id)]])
        before, held = self._relation_cache
        if not np.abs(now - before).max() < _UNMOVED_M:
            held = self.goal.holds(*map(pose_from_row, now))
            self._relation_cache = (now, held)
        return held

    def _write_instruction(self, scene: Scene) -> str:
        phrases = read_object_phrases(scene.meta)
        x, y = (phrases.get(name, f"the {name}") for name in (self.goal.x_id, self.goal.y_id))
        return write_instruction(x, self.goal.relation, y)

    def _find_recorded_base(self, scene: Scene, row: Mapping[str, Any]) -> Pose | None:
        for tried in scene.trajectory_rows():
            same = tried["task_id"] == row.get("task_id") and tried["robot"] == self.station.arm.name
            if same and tried["base_yaw_rad"] is not None:
                position = np.array([tried[f"base_{axis}_m"] for axis in "xyz"], dtype=np.float64)
                return Pose(position, quaternion_about_z(float(tried["base_yaw_rad"])))
        return None

    def _find_best_base(self) -> Pose:
        data = self.station.data()
        targets = data.xipos[[self.station.object_bodies[name] for name in (self.goal.x_id, self.goal.y_id)]]
        found = find_bases(self.station, np.array(targets), most=1)
        if not found:
            raise InputError(f"no place for {self.station.arm.name} reaches both objects: give a base", "no_base")
        return found[0]


def _compute_box(mesh: TriangleMesh) -> tuple[Vector3, Vector3]:
    """Compute middle and half size [m]."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return (low + high) / 2, (high - low) / 2


def _check_task(scene: Scene, task: Mapping[str, Any]) -> None:
    """Refuse a task of one's own with a misspelt key, an unknown object, or an instruction that is no text."""
    for key in sorted(str(key) for key in task.keys() - TASK_KEYS):
        if close := get_close_matches(key.casefold(), TASK_KEYS, n=1, cutoff=0.7):
            raise InputError(f"task: {sanitize_line(key, 60)!r} is no key: did you mean {close[0]}?", "bad_task")
    known = [*read_object_names(scene.meta)]
    for key in ("x_id", "y_id"):
        if known and task.get(key) not in known:
            given, there = sanitize_line(repr(task.get(key)), 60), sanitize_line(", ".join(known[:10]), 200)
            raise InputError(f"task: {key} {given} is no object of {scene.scene_id}; there are {there}", "bad_task")
    if not isinstance(words := task.get("instruction"), str | None):
        raise InputError(f"task: instruction {sanitize_line(repr(words), 60)}: give text, or leave it out", "bad_task")


def _find_task(scene: Scene, task: object) -> Mapping[str, Any]:
    """Find a task of `meta.json` by id, or return the given one."""
    if isinstance(task, Mapping):
        _check_task(scene, task)
        return task
    if not isinstance(task, str):
        raise InputError(f"task {sanitize_line(repr(task), 80)}: give an id, or x_id, y_id and relation", "bad_task")
    assessment = scene.meta.get("assessment")
    tasks = assessment.get("tasks") if isinstance(assessment, dict) else None
    rows = [row for row in tasks if isinstance(row, dict)] if isinstance(tasks, list) else []
    for row in rows:
        if row.get("task_id") == task:
            return row
    known = sanitize_line(", ".join(str(row.get("task_id")) for row in rows[:10]), 200) or "none"
    raise InputError(f"scene {scene.scene_id} has no task {sanitize_line(task, 80)!r}; there are: {known}", "bad_task")
