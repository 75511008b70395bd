"""A scene and a task as a Gymnasium environment, `TableVerse/PickPlace-v0` where this module is imported."""

from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from schemas.geometry import Picture, Pose
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Scene, open_dataset
from tableverse_factory.delivery.learning.camera import Sight
from tableverse_factory.delivery.learning.pick_place_sim import Cell, Standing
from tableverse_factory.delivery.learning.variation import Variation, lighting_of, table_seed
from tableverse_factory.physics.render.render import Lighting

ENVIRONMENT_ID = "TableVerse/PickPlace-v0"
FPS = 50
MAX_STEPS = 1000
_MAX_PX = 4096

_ROOM_M, _SPEED = 3.0, 20.0
"""Observations are cut to these: positions [m], and speeds of joints [rad/s]."""


class TableEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):  # type: ignore[misc]
    """Pick up X and bring it into a relation to Y, with an arm on an exported scene.

    An action of shape (j + 1,) in -1 … 1 says where the joints are to be, between their limits, and how far the gripper
    is to open, after 1/50 s. What counts as done is what counts in trajectories/ (`learning.cell`); then the reward is
    1 and the episode terminates. It also terminates, with `info["failure"]`, when it cannot succeed any more. An
    episode that has ended takes no further step.

    Observations, all in the table frame: `state` (joints [rad], their speeds [rad/s], opening [m], gripper's position
    and quaternion wxyz), `objects` (position and quaternion wxyz of X, of Y and of all others, then zeros up to
    `max_objects`), and `camera` where asked for.
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
        camera: tuple[int, int] | None = None,
        render_mode: str | None = None,
        render_size: tuple[int, int] = (480, 640),
    ) -> None:
        """Compiles the scene with its arm; pictures are prepared when the first is asked for.

        Args:
            scene: Of a dataset.
            task: Id of one of its tasks, or one of your own: `x_id`, `y_id` and `relation`.
            robot: As in `robots.doors.arm_of`.
            base: Where the arm stands; by default as in `learning.cell.Cell`.
            reward: `sparse`: 1 when done, else 0. `dense`: besides, what was gained or lost on the way since the step
                before, 1 at most in all (`learning.reward`).
            max_steps: After so many steps of 1/50 s the episode is truncated; None: never.
            max_objects: Rows of `objects`, where environments of several scenes are to have equal spaces.
            max_disturbed_m: How far any other object may be moved [m].
            variation: What resets change; nothing by default. `reset(options={"variation": …})` replaces it once.
            camera: Height and width of the picture in each observation [px]; none by default.
            render_mode: `rgb_array` or None.
            render_size: Height and width of what `render` gives [px].

        Raises:
            InputError: as `Cell`.
            ConfigError: for an argument that is none, or more objects than `max_objects`.
        """
        if reward not in ("sparse", "dense") or render_mode not in (None, "rgb_array"):
            raise ConfigError(
                f"reward {reward!r}, render_mode {render_mode!r}: 'sparse' or 'dense', None or 'rgb_array'"
            )
        self.render_mode = render_mode
        self.cell = Cell(scene, task, robot, base, 1.0 / FPS, max_disturbed_m)
        self._scene, self._reward = scene, reward
        self._max_steps = None if max_steps is None else _count("max_steps", max_steps, 1)
        self._variation = _variation(Variation() if variation is None else variation)
        self._camera = None if camera is None else _size("camera", camera)
        self._render_size = _size("render_size", render_size)
        objects = len(self.cell.object_ids)
        self._rows = objects if max_objects is None else _count("max_objects", max_objects, objects)
        self._sights: dict[tuple[int, int], Sight] = {}
        self._look: tuple[int | None, Lighting | None] = (None, None)
        self._steps = 0
        self._standing: Standing | None = None
        arm = self.cell.station.arm
        self._low, self._high = np.array([*arm.lower, 0.0]), np.array([*arm.upper, arm.max_opening_m])
        self.action_space = spaces.Box(-1.0, 1.0, (len(self._low),), np.float32)
        self.observation_space = self._observation_space(len(arm.lower), arm.max_opening_m)

    def command_of(self, action: np.ndarray) -> np.ndarray:
        """Targets of the joints [rad] and the opening [m] that an action means. Shape (j + 1,).

        Raises:
            InputError: `bad_action` if it has another shape, or is not finite.
        """
        share = (np.clip(self._numbers("action", action), -1.0, 1.0) + 1.0) / 2.0
        command: np.ndarray = self._low + share * (self._high - self._low)
        return command

    def action_of(self, command: np.ndarray) -> np.ndarray:
        """The action that means a command, as recorded trajectories hold them. Shape (j + 1,).

        Raises:
            InputError: as `command_of`.
        """
        share = (self._numbers("command", command) - self._low) / (self._high - self._low)
        action: np.ndarray = np.clip(2.0 * share - 1.0, -1.0, 1.0).astype(np.float32)
        return action

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The scene as exported, but for what the variation asks for; the arm at home.

        Args:
            seed: Of everything that is drawn, from now on.
            options: `variation`: another one for this episode.

        Raises:
            ConfigError: for another option, or a variation that is none.
        """
        super().reset(seed=seed)
        if other := [name for name in options or {} if name != "variation"]:
            raise ConfigError(f"no option {sanitize_line(repr(other[0]), 60)}; there is 'variation'")
        variation = _variation((options or {}).get("variation", self._variation))
        standing = self._standing = self.cell.reset(self.np_random, variation)
        table = table_seed(self.np_random) if variation.table else None
        lighting = lighting_of(self.np_random) if variation.lights else None
        if (table, lighting) != self._look:
            self._look, self._sights = (table, lighting), {}
        self._steps = 0
        return self._observation(standing), self._info(standing)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """One command, 1/50 s.

        Raises:
            InputError: as `command_of`.
            gymnasium.error.ResetNeeded: before the first reset, and once the episode has ended.
        """
        before = self._now.progress
        if self._steps > 0 and any(self._ends(self._now)):
            raise gymnasium.error.ResetNeeded("the episode has ended: call reset()")
        standing = self._standing = self.cell.step(self.command_of(action))
        self._steps += 1
        reward = standing.progress - before if self._reward == "dense" else 0.0
        ended, truncated = self._ends(standing)
        return self._observation(standing), reward + standing.success, ended, truncated, self._info(standing)

    def render(self) -> Picture | None:
        """What the camera that stands with the robot sees, of shape (h, w, 3); None where no render mode was asked."""
        return None if self.render_mode is None else self._picture(self._render_size)

    def _ends(self, standing: Standing) -> tuple[bool, bool]:
        """Whether the episode is terminated, or else truncated."""
        ended = standing.success or bool(standing.failure)
        return ended, not ended and self._max_steps is not None and self._steps >= self._max_steps

    def _numbers(self, name: str, values: np.ndarray) -> np.ndarray:
        numbers = np.asarray(values, dtype=np.float64)
        if numbers.shape != self._low.shape or not np.isfinite(numbers).all():
            said = sanitize_line(np.array2string(numbers, precision=3, threshold=10), 120)
            raise InputError(f"{name} {said}: give finite numbers, shape {self._low.shape}", "bad_action")
        return numbers

    def _observation_space(self, joints: int, opening_m: float) -> spaces.Dict:
        pose = [*[_ROOM_M] * 3, *[1.0] * 4]
        low = [*self._low[:-1] - 0.1, *[-_SPEED] * joints, -0.01, *np.negative(pose)]
        high = [*self._high[:-1] + 0.1, *[_SPEED] * joints, opening_m + 0.01, *pose]
        rows = np.tile(np.array(pose, dtype=np.float32), (self._rows, 1))
        seen: dict[str, spaces.Space[Any]] = {
            "state": spaces.Box(np.array(low, dtype=np.float32), np.array(high, dtype=np.float32), dtype=np.float32),
            "objects": spaces.Box(-rows, rows, dtype=np.float32),
        }
        if self._camera is not None:
            seen["camera"] = spaces.Box(0, 255, (*self._camera, 3), np.uint8)
        return spaces.Dict(seen)

    def _observation(self, standing: Standing) -> dict[str, np.ndarray]:
        sample, joints = standing.sample, len(self._low) - 1
        opening = self.cell.opening()
        state = np.concatenate([sample.qpos[:joints], sample.qvel[:joints], [opening], sample.tcp])
        objects = np.zeros((self._rows, 7), dtype=np.float32)
        objects[: len(self.cell.object_ids)] = self.cell.poses()
        seen = {"state": state.astype(np.float32), "objects": objects}
        for name, values in seen.items():
            space = self.observation_space[name]
            np.clip(values, space.low, space.high, out=values)
        return seen if self._camera is None else {**seen, "camera": self._picture(self._camera)}

    def _picture(self, size: tuple[int, int]) -> Picture:
        sample = self._now.sample
        if size not in self._sights:
            station = self.cell.station
            self._sights[size] = Sight(self._scene, station.arm, station.base, size, *self._look)
        poses = dict(zip(self.cell.object_ids, self.cell.poses(), strict=True))
        return self._sights[size].picture(poses, sample.qpos)

    @property
    def _now(self) -> Standing:
        if self._standing is None:
            raise gymnasium.error.ResetNeeded("call reset() first")
        return self._standing

    def _info(self, standing: Standing) -> dict[str, Any]:
        return {
            "success": standing.success,
            "failure": standing.failure,
            "lifted": standing.lifted,
            "at_rest": standing.at_rest,
            "fingers": int(standing.sample.pads).bit_count(),
            "disturbed_m": standing.disturbed_m,
        }


def made(dataset: str, scene: str, task: str, **options: Any) -> TableEnv:
    """The environment by names alone, as `gymnasium.make` and processes of their own can take them.

    Args:
        dataset: As in `open_dataset`.
        scene: Id of one of its scenes.
        task: Id of one of its tasks.
        options: As in `TableEnv`, but for `max_steps`: Gymnasium itself truncates.

    Raises:
        ConfigError: as `TableEnv`, or for `max_steps`.
    """
    if "max_steps" in options:
        raise ConfigError(f"max_steps {options['max_steps']!r}: gymnasium.make has max_episode_steps, -1 for no limit")
    return TableEnv(open_dataset(dataset).scene(scene), task, max_steps=None, **options)


def _count(name: str, value: object, least: int) -> int:
    if not isinstance(value, int | np.integer) or value < least:
        raise ConfigError(f"{name} {value!r}: give a whole number from {least} on")
    return int(value)


def _size(name: str, value: object) -> tuple[int, int]:
    sides = tuple(value) if isinstance(value, Sequence | np.ndarray) else ()
    if len(sides) != 2 or not all(isinstance(side, int | np.integer) and 1 <= side <= _MAX_PX for side in sides):
        raise ConfigError(f"{name} {value!r}: give height and width, each from 1 to {_MAX_PX} px")
    return int(sides[0]), int(sides[1])


def _variation(value: object) -> Variation:
    if not isinstance(value, Variation):
        raise ConfigError(f"variation {sanitize_line(repr(value), 60)}: give a Variation")
    return value


gymnasium.register(ENVIRONMENT_ID, entry_point=f"{__name__}:made", max_episode_steps=MAX_STEPS)
