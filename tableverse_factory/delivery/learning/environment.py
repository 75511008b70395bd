"""Gymnasium environment of a scene and a task; `TableVerse/PickPlace-v0` is registered on import."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from schemas.geometry import Picture, Pose
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.episodes.cameras import CameraShift
from tableverse_factory.delivery.episodes.instructions import paraphrase_instruction
from tableverse_factory.delivery.episodes.observation import build_state, pad_objects
from tableverse_factory.delivery.episodes.pictures import DEPTH, INSTANCES, MAX_DEPTH_M, check_pictures
from tableverse_factory.delivery.learning.camera import SceneCameras
from tableverse_factory.delivery.learning.pick_place_sim import PickPlaceSim, SimState
from tableverse_factory.delivery.learning.variation import (
    Variation,
    draw_camera_shift,
    draw_lighting,
    draw_table_seed,
)
from tableverse_factory.physics.render.render import Lighting

ENVIRONMENT_ID = "TableVerse/PickPlace-v0"
FPS = 50
MAX_STEPS = 1000
_MAX_PX = 4096
_TOLD = ("success", "failure", "subtask", "lifted", "at_rest", "disturbed_m")
_MAX_POSITION_M, _MAX_JOINT_SPEED = 3.0, 20.0  # bounds of observations: positions [m], and speeds of joints [rad/s]


class TableEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):  # type: ignore[misc]
    """Pick up X and bring it into a relation to Y, with an arm on an exported scene.

    An action of shape (j + 1,) in -1 … 1 sets the joint targets, between their limits, and the gripper's opening after
    1/50 s. Success is defined as in trajectories/ (`learning.pick_place_sim`); then the reward is 1 and the episode
    terminates. It also terminates, with `info["failure"]`, when it cannot succeed any more. An episode that has ended
    takes no further step.

    Observations, all in the table frame: `state` (joints [rad], their speeds [rad/s], opening [m], gripper's position
    and quaternion wxyz), `objects` (position and quaternion wxyz of X, of Y and of all others, then zeros up to
    `max_objects`), and the pictures that are asked for, by name (`episodes.pictures.PICTURES`).
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}  # noqa: RUF012 - as Gymnasium has it

    def __init__(
        self,
        scene: Scene,
        task: str | Mapping[str, Any],
        robot: str = "panda",
        *,
        base: Pose | None = None,
        reward: str = "sparse",
        max_steps: int | None = MAX_STEPS,
        max_objects: int | None = None,
        max_disturbed_m: float = 0.02,
        variation: Variation | None = None,
        pictures: Sequence[str] = (),
        picture_size: tuple[int, int] = (96, 128),
        render_mode: str | None = None,
        render_size: tuple[int, int] = (480, 640),
    ) -> None:
        """Compile the scene with its arm; cameras are prepared on first use.

        Args:
            scene: Of a dataset.
            task: Id of one of its tasks, or one of your own: `x_id`, `y_id` and `relation`.
            robot: As in `robots.registry.load_arm`.
            base: Pose of the arm's base; by default as in `PickPlaceSim`.
            reward: `sparse`: 1 on success, else 0. `dense`: adds the progress gained or lost in the step, at most 1 in
                all (`learning.reward`).
            max_steps: Steps of 1/50 s after which the episode is truncated; None: never.
            max_objects: Rows of `objects`, for equal spaces over several scenes.
            max_disturbed_m: Allowed displacement of any other object [m].
            variation: What resets change; nothing by default. `reset(options={"variation": …})` replaces it once.
            pictures: Pictures in each observation: `front`, `wrist` and `scene`, each also with `_depth` and
                `_instances` (`episodes.pictures.PICTURES`).
            picture_size: Their height and width [px].
            render_mode: `rgb_array` or None.
            render_size: Height and width of the pictures of `render` [px].
        """
        if reward not in ("sparse", "dense"):
            raise ConfigError(f"reward {reward!r}: give 'sparse' or 'dense'")
        if render_mode not in (None, "rgb_array"):
            raise ConfigError(
                f"render_mode {render_mode!r}: None or 'rgb_array'; 'human' needs gymnasium.make, which opens a window"
            )
        self.render_mode = render_mode
        self.sim = PickPlaceSim(scene, task, robot, base, 1.0 / FPS, max_disturbed_m)
        self.scene, self._reward = scene, reward
        self._max_steps = None if max_steps is None else _check_count("max_steps", max_steps, 1)
        self._variation = _check_variation(Variation() if variation is None else variation)
        self._pictures = check_pictures(pictures)
        self._picture_size = _check_size("picture_size", picture_size)
        self._render_size = _check_size("render_size", render_size)
        objects = len(self.sim.object_ids)
        self._rows = objects if max_objects is None else _check_count("max_objects", max_objects, objects)
        self._cameras: dict[str, SceneCameras] = {}
        self._look: tuple[int | None, Lighting | None, CameraShift | None] = (None, None, None)
        self._steps = 0
        self._state: SimState | None = None
        arm = self.sim.station.arm
        self._low, self._high = np.array([*arm.lower, 0.0]), np.array([*arm.upper, arm.max_opening_m])
        self.action_space = spaces.Box(-1.0, 1.0, (len(self._low),), np.float32)
        self.observation_space = self._observation_space(len(arm.lower), arm.max_opening_m)

    def action_to_command(self, action: np.ndarray) -> np.ndarray:
        """Convert an action to targets of the joints [rad] and the opening [m]. Shape (j + 1,)."""
        share = (np.clip(self._check_numbers("action", action), -1.0, 1.0) + 1.0) / 2.0
        return self._low + share * (self._high - self._low)

    def command_to_action(self, command: np.ndarray) -> np.ndarray:
        """Convert a command, as in recorded trajectories, to an action. Shape (j + 1,)."""
        share = (self._check_numbers("command", command) - self._low) / (self._high - self._low)
        return np.clip(2.0 * share - 1.0, -1.0, 1.0).astype(np.float32)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """Restore the exported scene, varied as requested, with the arm at home.

        `options["variation"]` replaces the environment's for this episode.
        """
        super().reset(seed=seed)
        if other := [name for name in options or {} if name != "variation"]:
            raise ConfigError(f"no option {sanitize_line(repr(other[0]), 60)}; there is 'variation'")
        variation = _check_variation((options or {}).get("variation", self._variation))
        state = self._state = self.sim.reset(self.np_random, variation)
        table = draw_table_seed(self.np_random) if variation.table else None
        lighting = draw_lighting(self.np_random) if variation.lights else None
        shift = draw_camera_shift(self.np_random) if variation.cameras else None
        if (table, lighting, shift) != self._look:
            self._look, self._cameras = (table, lighting, shift), {}
        self._steps = 0
        words = {"instruction": self.sim.instruction, "paraphrases": paraphrase_instruction(self.sim.instruction)}
        return self._observation(state), {**self._info(state), **words}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """Execute one action for 1/50 s; `ResetNeeded` before the first reset, and once the episode has ended."""
        before = self._now.progress
        if self._steps > 0 and any(self._ends(self._now)):
            raise gymnasium.error.ResetNeeded("the episode has ended: call reset()")
        state = self._state = self.sim.step(self.action_to_command(action))
        self._steps += 1
        reward = state.progress - before if self._reward == "dense" else 0.0
        ended, truncated = self._ends(state)
        return self._observation(state), reward + state.success, ended, truncated, self._info(state)

    def render(self) -> Picture | None:
        """Render the robot camera's picture, of shape (h, w, 3); None without a render mode."""
        if self.render_mode is None:
            return None
        return self._take("render", ("front",), self._render_size)["front"]

    def take_pictures(self, pictures: Sequence[str], size: tuple[int, int]) -> dict[str, np.ndarray]:
        """Take pictures of the present state, of height and width `size`, without having them in observations."""
        names, size = check_pictures(pictures), _check_size("size", size)
        return self._take(f"{names} {size}", names, size)

    def _ends(self, state: SimState) -> tuple[bool, bool]:
        """Return whether the episode is terminated, or else truncated."""
        ended = state.success or bool(state.failure)
        return ended, not ended and self._max_steps is not None and self._steps >= self._max_steps

    def _check_numbers(self, name: str, values: np.ndarray) -> np.ndarray:
        numbers = np.asarray(values, dtype=np.float64)
        if numbers.shape != self._low.shape or not np.isfinite(numbers).all():
            said = sanitize_line(np.array2string(numbers, precision=3, threshold=10), 120)
            raise InputError(f"{name} {said}: give finite numbers, shape {self._low.shape}", "bad_action")
        return numbers

    def _observation_space(self, joints: int, opening_m: float) -> spaces.Dict:
        pose = [*[_MAX_POSITION_M] * 3, *[1.0] * 4]
        low = [*self._low[:-1] - 0.1, *[-_MAX_JOINT_SPEED] * joints, -0.01, *np.negative(pose)]
        high = [*self._high[:-1] + 0.1, *[_MAX_JOINT_SPEED] * joints, opening_m + 0.01, *pose]
        rows = np.tile(np.array(pose, dtype=np.float32), (self._rows, 1))
        seen: dict[str, spaces.Space[Any]] = {
            "state": spaces.Box(np.array(low, dtype=np.float32), np.array(high, dtype=np.float32), dtype=np.float32),
            "objects": spaces.Box(-rows, rows, dtype=np.float32),
        }
        return spaces.Dict(seen | {name: _make_picture_space(name, self._picture_size) for name in self._pictures})

    def _observation(self, state: SimState) -> dict[str, np.ndarray]:
        sample, arm = state.sample, self.sim.station.arm
        robot = build_state(arm, sample.qpos[None], sample.qvel[None], sample.tcp[None])[0]
        seen = {"state": robot, "objects": pad_objects(self.sim.poses(), self._rows)}
        for name, values in seen.items():
            space = self.observation_space[name]
            np.clip(values, space.low, space.high, out=values)
        return {**seen, **self._take("observation", self._pictures, self._picture_size)} if self._pictures else seen

    def _take(self, use: str, pictures: Sequence[str], size: tuple[int, int]) -> dict[str, np.ndarray]:
        """Take pictures of the present state; cameras are kept by their use."""
        names, sample = self.sim.object_ids, self._now.sample
        if use not in self._cameras:
            self._cameras[use] = SceneCameras(self.scene, self.sim.station, names, pictures, size, *self._look)
        return self._cameras[use].take(dict(zip(names, self.sim.poses(), strict=True)), sample.qpos, sample.tcp)

    @property
    def _now(self) -> SimState:
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        return self._state

    def _info(self, state: SimState) -> dict[str, Any]:
        told = {name: getattr(state, name) for name in _TOLD}
        return {**told, "fingers": int(state.sample.pads).bit_count()}


def _make_picture_space(name: str, size: tuple[int, int]) -> spaces.Box:
    if name.endswith(DEPTH):
        return spaces.Box(0.0, MAX_DEPTH_M, (*size, 1), np.float32)
    return spaces.Box(0, 255, (*size, 1 if name.endswith(INSTANCES) else 3), np.uint8)


def _check_count(name: str, value: object, least: int) -> int:
    if not isinstance(value, int | np.integer) or value < least:
        raise ConfigError(f"{name} {value!r}: give a whole number from {least} on")
    return int(value)


def _check_size(name: str, value: object) -> tuple[int, int]:
    sides = tuple(value) if isinstance(value, Sequence | np.ndarray) else ()
    if len(sides) != 2 or not all(isinstance(side, int | np.integer) and 1 <= side <= _MAX_PX for side in sides):
        raise ConfigError(f"{name} {value!r}: give height and width, each from 1 to {_MAX_PX} px")
    return int(sides[0]), int(sides[1])


def _check_variation(value: object) -> Variation:
    if not isinstance(value, Variation):
        raise ConfigError(f"variation {sanitize_line(repr(value), 60)}: give a Variation")
    return value


gymnasium.register(
    ENVIRONMENT_ID,
    entry_point="tableverse_factory.delivery.learning.dataset_environment:make_environment",
    max_episode_steps=MAX_STEPS,
)
