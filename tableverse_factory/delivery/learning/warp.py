"""Different scenes in one batch of MuJoCo Warp, which steps a world per scene on a GPU, or on the CPU to try it."""

from collections.abc import Sequence
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float64

from tableverse_factory.core.errors import ConfigError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.learning.warp_template import WarpTemplate, build_template


class WarpBatch:
    """Worlds of MuJoCo Warp, one for each scene in order; each object of a world has the same slot in all arrays.

    Attributes:
        model: `mujoco_warp.Model`, with shapes, masses and poses per world.
        data: `mujoco_warp.Data` of all worlds; its arrays may be written between steps.
        template: `mujoco.MjModel` of one world with all slots.
        object_ids: Of each world, in the order of the slots.
        models: What MuJoCo itself has of each world's scene, without visuals, to compare with.
    """

    def __init__(
        self,
        scenes: Sequence[Scene],
        nconmax: int | None = None,
        njmax: int | None = None,
        device: str | None = None,
        exported_settings: bool = False,
    ) -> None:
        """Load the scenes on a device.

        Args:
            scenes: May contain a scene more than once, whose meshes are then stored once.
            nconmax: Contacts per world; by default what the greediest scene needs (`physics.simulate.sizes`).
            njmax: Constraints per world; likewise.
            device: Of Warp, as `cuda:1`, or `cpu`; by default Warp's own choice.
            exported_settings: Keep no-slip iterations and integrator of the scenes. Without, there are no no-slip
                iterations, with which things creep in Warp's single precision, and explicit integration.

        Raises:
            InputError: `bad_scene` for scenes that do not fit into one batch, `no_extra` without mujoco-warp.
        """
        if not scenes:
            raise ConfigError("no scenes: give at least one")
        self._warp, self._engine = import_warp()
        different = {scene.scene_id: scene for scene in scenes}
        order = list(different)
        self._template = build_template(list(different.values()))
        self._kinds = [order.index(scene.scene_id) for scene in scenes]
        self.scene_ids = tuple(scene.scene_id for scene in scenes)
        self.template = self._template.model
        self.object_ids = tuple(self._template.scenes[kind].object_ids for kind in self._kinds)
        self.models = tuple(self._template.scenes[kind].model for kind in self._kinds)
        sizes = [scene.sizes for scene in self._template.scenes]
        self.nconmax = nconmax or max(size.nconmax for size in sizes)
        self.njmax = njmax or max(size.njmax for size in sizes)
        with self._warp.ScopedDevice(device):
            self.model = self._put_model(self._template)
            self.data = self._engine.make_data(
                self.template, nworld=len(scenes), nconmax=self.nconmax, njmax=self.njmax
            )
        self._start = self._stack("qpos0")
        self._graph: Any = None
        if not exported_settings:
            self.model.opt.noslip_iterations, self.model.opt.integrator = 0, int(mujoco.mjtIntegrator.mjINT_EULER)
        self.reset()

    def reset(self, worlds: Bool[np.ndarray, " n"] | None = None) -> None:
        """Put all worlds, or those chosen, back to the exported scenes, at rest."""
        chosen = np.ones(len(self.scene_ids), dtype=bool) if worlds is None else np.asarray(worlds, dtype=bool)
        if chosen.shape != (len(self.scene_ids),):
            raise ConfigError(f"worlds of shape {chosen.shape}: give one truth value for each of {len(self.scene_ids)}")
        with self._warp.ScopedDevice(self.data.qpos.device):
            self._engine.reset_data(self.model, self.data, self._warp.array(chosen, dtype=bool))
            position = self.data.qpos.numpy()
            position[chosen] = self._start[chosen]
            self.data.qpos.assign(position)
            self._engine.forward(self.model, self.data)

    def step(self, steps: int = 1) -> None:
        """Step all worlds; the device may still be at work when this returns (`warp.synchronize`)."""
        device = self.data.qpos.device
        with self._warp.ScopedDevice(device):
            if device.is_cuda and self._graph is None and steps:  # one launch per step in place of hundreds
                self._engine.step(self.model, self.data)
                steps -= 1
                with self._warp.ScopedCapture() as capture:
                    self._engine.step(self.model, self.data)
                self._graph = capture.graph
            for _ in range(steps):
                if self._graph is None:
                    self._engine.step(self.model, self.data)
                else:
                    self._warp.capture_launch(self._graph)

    def poses(self) -> Float64[np.ndarray, "worlds slots 7"]:
        """Return position [m] and quaternion wxyz of all objects in their table frames, NaN in unused slots."""
        poses: Float64[np.ndarray, "worlds slots 7"] = (
            self.data.qpos.numpy().astype(np.float64).reshape(len(self.scene_ids), -1, 7)
        )
        for world, names in enumerate(self.object_ids):
            poses[world, len(names) :] = np.nan
        return poses

    def overflowed(self) -> Bool[np.ndarray, " worlds"]:
        """Return which worlds needed more contacts or constraints than were allotted, and so are wrong."""
        return np.asarray(self.data.overflow.numpy()).reshape(-1) != 0

    def _put_model(self, template: WarpTemplate) -> Any:
        names = tuple(template.worlds[0])
        model = self._engine.put_model(self.template, batch_sizes=dict.fromkeys(names, len(self._kinds)))
        for name in names:
            getattr(model, name).assign(self._stack(name))
        return model

    def _stack(self, name: str) -> np.ndarray:
        return np.stack([self._template.worlds[kind][name] for kind in self._kinds])


def import_warp() -> tuple[ModuleType, ModuleType]:
    """Import Warp and MuJoCo Warp; `no_extra` if they are not installed."""
    engine = import_extra("mujoco_warp", "WarpBatch", "warp")
    warp = import_extra("warp", "WarpBatch", "warp")
    return warp, engine


def silence_warp(extra: str = "warp") -> None:
    """Keep Warp's news from standard output, for commands whose output programs read."""
    warp = import_extra("warp", "this command", extra)
    warp.config.log_level = warp.LOG_WARNING
