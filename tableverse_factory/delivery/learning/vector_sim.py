"""Vectorized simulation of scenes, each in its own model, on threads, as MuJoCo steps without Python's lock.

For many starts of one scene use `mujoco.rollout`, which needs models of equal sizes (docs/cookbook.md).
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
from tableverse_factory.physics.mjcf.load import load_spec
from tableverse_factory.physics.simulate.at_rest import make_quiet_data
from tableverse_factory.robotics.robots.station import delete_visual_meshes

Control = Callable[[int, mujoco.MjModel, mujoco.MjData], None]


class VectorSim:
    """Models and data of scenes, in order, with threads that step them; `data` is initially as exported."""

    def __init__(self, scenes: Sequence[Scene], threads: int | None = None, visuals: bool = False) -> None:
        """Compile the scenes; one may be given several times.

        By default there are as many threads as this process has cores. `visuals` keeps visual geoms, for pictures.
        """
        threads = len(os.sched_getaffinity(0)) if threads is None else threads
        if not scenes or threads < 1:
            raise ConfigError(f"{len(scenes)} scenes on {threads} threads: give at least one of both")
        self.scene_ids = tuple(scene.scene_id for scene in scenes)
        self.models = tuple(compile_scene(scene, visuals) for scene in scenes)
        self.data = tuple(make_quiet_data(model) for model in self.models)
        self._pool = ThreadPoolExecutor(threads)

    def step(self, steps: int = 1, control: Control | None = None) -> None:
        """Step all scenes by their own timestep; larger batches of steps cost less.

        `control` is called before, per scene in a thread, with its index, model and data, in which it may set forces,
        controls or states. Its exceptions are raised once all scenes have been stepped.
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
        """Stop the threads."""
        self._pool.shutdown()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.close()


def load_scene_spec(scene: Scene, visuals: bool) -> mujoco.MjSpec:
    """Load the specification of a scene, to edit and attach."""
    try:
        spec = load_spec(scene.files())
    except InputError as error:
        raise InputError(f"scene {scene.scene_id}: {error}", error.reason) from None
    if not visuals:
        delete_visual_meshes(spec)
        spec.compiler.discardvisual = True
    return spec


def compile_scene(scene: Scene, visuals: bool) -> mujoco.MjModel:
    """Compile a scene, with or without visual geoms."""
    try:
        return load_scene_spec(scene, visuals).compile()
    except ValueError as error:
        message = sanitize_line(str(error), 500)
        raise InputError(f"scene {scene.scene_id}: scene.xml does not load: {message}", "bad_mjcf") from error
