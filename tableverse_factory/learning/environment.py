"""A scene and a task as a Gymnasium environment, `TableVerse/PickPlace-v0` where this module is imported."""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from schemas.geometry import Picture, Pose
from tableverse_factory.dataset import Scene, open_dataset
from tableverse_factory.errors import ConfigError
from tableverse_factory.learning.cell import Cell, Standing
from tableverse_factory.learning.sight import Sight
from tableverse_factory.learning.variation import Variation, lighting_of, table_seed
from tableverse_factory.physics.render import Lighting

ENVIRONMENT_ID = "TableVerse/PickPlace-v0"
FPS = 50

_ROOM_M, _SPEED = 3.0, 20.0
"""Observations are cut to these: positions [m], and speeds of joints [rad/s]."""


class TableEnv(gymnasium.Env[dict[str, np.ndarray], np.ndarray]):  # type: ignore[misc]
    """Pick up X and bring it into a relation to Y, with an arm on an exported scene.

    An action of shape (j + 1,) in -1 … 1 says where the joints are to be, between their limits, and how far the gripper
    is to open, after 1/50 s. What counts as done is what counts in trajectories/ (`learning.cell`); then the reward is
    1 and the episode terminates. It also terminates, with `info["failure"]`, when it cannot succeed any more.

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
        max_steps: int = 1000,
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
            max_steps: After so many steps of 1/50 s the episode is truncated.
            max_objects: Rows of `objects`, where environments of several scenes are to have equal spaces.
            max_disturbed_m: How far any other object may be moved [m].
            variation: What resets change; nothing by default. `reset(options={"variation": …})` replaces it once.
            camera: Height and width of the picture in each observation [px]; none by default.
            render_mode: `rgb_array` or None.
            render_size: Height and width of what `render` gives [px].

        Raises:
            InputError: as `Cell`.
            ConfigError: for a reward or a render mode that is none, or more objects than `max_objects`.
        """
        if reward not in ("sparse", "dense") or render_mode not in (None, "rgb_array"):
            raise ConfigError(
                f"reward {reward!r}, render_mode {render_mode!r}: 'sparse' or 'dense', None or 'rgb_array'"
            )
        self.render_mode = render_mode
        self.cell = Cell(scene, task, robot, base, 1.0 / FPS, max_disturbed_m)
        self._scene, self._reward, self._max_steps = scene, reward, max_steps
        self._variation, self._camera, self._render_size = variation or Variation(), camera, render_size
        self._rows = max_objects or len(self.cell.object_ids)
        if self._rows < len(self.cell.object_ids):
            raise ConfigError(f"the scene has {len(self.cell.object_ids)} objects: give max_objects as many or more")
        self._sights: dict[tuple[int, int], Sight] = {}
        self._look: tuple[int | None, Lighting | None] = (None, None)
        self._steps = 0
        self._standing: Standing | None = None
        arm = self.cell.station.arm
        self._low, self._high = np.array([*arm.lower, 0.0]), np.array([*arm.upper, arm.max_opening_m])
        self.action_space = spaces.Box(-1.0, 1.0, (len(self._low),), np.float32)
        self.observation_space = self._observation_space(len(arm.lower), arm.max_opening_m)

    def command_of(self, action: np.ndarray) -> np.ndarray:
        """Targets of the joints [rad] and the opening [m] that an action means. Shape (j + 1,)."""
        share = (np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0) + 1.0) / 2.0
        command: np.ndarray = self._low + share * (self._high - self._low)
        return command

    def action_of(self, command: np.ndarray) -> np.ndarray:
        """The action that means a command, as recorded trajectories hold them. Shape (j + 1,)."""
        share = (np.asarray(command, dtype=np.float64) - self._low) / (self._high - self._low)
        action: np.ndarray = np.clip(2.0 * share - 1.0, -1.0, 1.0).astype(np.float32)
        return action

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        """The scene as exported, but for what the variation asks for; the arm at home.

        Args:
            seed: Of everything that is drawn, from now on.
            options: `variation`: another one for this episode.
        """
        super().reset(seed=seed)
        variation = (options or {}).get("variation", self._variation)
        if not isinstance(variation, Variation):
            raise ConfigError(f"options['variation'] is a {type(variation).__name__}: give a Variation")
        standing = self._standing = self.cell.reset(self.np_random, variation)
        table = table_seed(self.np_random) if variation.table else None
        lighting = lighting_of(self.np_random) if variation.lights else None
        if (table, lighting) != self._look:
            self._look, self._sights = (table, lighting), {}
        self._steps = 0
        return self._observation(standing), self._info(standing)

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        """One command, 1/50 s."""
        before = self._now.progress
        standing = self._standing = self.cell.step(self.command_of(action))
        self._steps += 1
        reward = standing.progress - before if self._reward == "dense" else 0.0
        ended = standing.success or bool(standing.failure)
        truncated = not ended and self._steps >= self._max_steps
        return self._observation(standing), reward + standing.success, ended, truncated, self._info(standing)

    def render(self) -> Picture | None:
        """What the camera that stands with the robot sees, of shape (h, w, 3); None where no render mode was asked."""
        return None if self.render_mode is None else self._picture(self._render_size)

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
        options: As in `TableEnv`.
    """
    return TableEnv(open_dataset(dataset).scene(scene), task, **options)


gymnasium.register(ENVIRONMENT_ID, entry_point=f"{__name__}:made")
