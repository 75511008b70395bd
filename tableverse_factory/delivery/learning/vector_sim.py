"""Many scenes simulated at once, each in a model of its own, on threads: MuJoCo steps outside of Python's lock.

For many starts of one scene take `mujoco.rollout`, which wants models of equal sizes (docs/cookbook.md).
"""

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from types import TracebackType
from typing import Self

import mujoco

from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.physics.mjcf.load import spec_of
from tableverse_factory.physics.simulate.at_rest import quiet_data
from tableverse_factory.robotics.robots.station import drop_visual_meshes

Control = Callable[[int, mujoco.MjModel, mujoco.MjData], None]


class ManyScenes:
    """Models and data of some scenes, in their order, and threads that step them.

    Attributes:
        scene_ids: Which.
        models: Compiled.
        data: A state for each, as exported in the beginning.
    """

    def __init__(self, scenes: Sequence[Scene], threads: int | None = None, visuals: bool = False) -> None:
        """Compiles every scene.

        Args:
            scenes: Which; the same one may be there again.
            threads: How many; as many as there are cores for this process by default.
            visuals: Keep what is only seen, for pictures.

        Raises:
            InputError: if a scene does not load.
            ConfigError: if there is no scene, or no thread.
        """
        threads = len(os.sched_getaffinity(0)) if threads is None else threads
        if not scenes or threads < 1:
            raise ConfigError(f"{len(scenes)} scenes on {threads} threads: give at least one of both")
        self.scene_ids = tuple(scene.scene_id for scene in scenes)
        self.models = tuple(compiled(scene, visuals) for scene in scenes)
        self.data = tuple(quiet_data(model) for model in self.models)
        self._pool = ThreadPoolExecutor(threads)

    def step(self, steps: int = 1, control: Control | None = None) -> None:
        """Steps all of them; more steps at once cost less.

        Args:
            steps: Of each model's own timestep.
            control: Called before, for each scene in a thread: its number, its model and its data, in which it may set
                forces, controls or states. What it raises is raised once all other scenes have been stepped.
        """

        def advance(number: int) -> None:
            model, data = self.models[number], self.data[number]
            if control is not None:
                control(number, model, data)
            mujoco.mj_step(model, data, nstep=steps)

        under_way = [self._pool.submit(advance, number) for number in range(len(self.models))]
        wait(under_way)
        for stepped in under_way:
            stepped.result()

    def close(self) -> None:
        """Ends the threads."""
        self._pool.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def scene_spec(scene: Scene, visuals: bool) -> mujoco.MjSpec:
    """The specification of a scene, to edit and attach.

    Args:
        scene: Which.
        visuals: Keep what is only seen.

    Raises:
        InputError: if it does not load.
    """
    try:
        spec = spec_of(scene.files())
    except InputError as error:
        raise InputError(f"scene {scene.scene_id}: {error}", error.reason) from None
    if not visuals:
        drop_visual_meshes(spec)
        spec.compiler.discardvisual = True
    return spec


def compiled(scene: Scene, visuals: bool) -> mujoco.MjModel:
    """The model of a scene, with or without what is only seen.

    Raises:
        InputError: if it does not load.
    """
    try:
        return scene_spec(scene, visuals).compile()
    except ValueError as error:
        message = sanitize_line(str(error), 500)
        raise InputError(f"scene {scene.scene_id}: scene.xml does not load: {message}", "bad_mjcf") from error
