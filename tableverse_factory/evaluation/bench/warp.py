"""Speed of MuJoCo Warp on scenes of a dataset, and its agreement with MuJoCo."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.dataset.dataset import Dataset, Scene, open_dataset
from tableverse_factory.delivery.learning.warp import WarpBatch, import_warp
from tableverse_factory.evaluation.engine_drift import EngineDrift, measure_mujoco_drift, measure_warp_drift

SCENES_PER_BATCH = 128
_TIMED_S = 3.0  # least time that is measured


@dataclass(frozen=True, slots=True)
class WarpSpeed:
    """Steps of all worlds together in a second of wall time."""

    worlds: int
    different: int  # scenes among them
    device: str
    steps_per_s: float
    nconmax: int
    njmax: int
    overflowed: int  # worlds that lacked room, whose steps are not those of the scene


@dataclass(frozen=True, slots=True)
class EngineAgreement:
    """What Warp and MuJoCo say of the same scene, over the same time."""

    warp: EngineDrift
    mujoco: EngineDrift

    @property
    def agrees(self) -> bool:
        """Whether both say the same about rest."""
        return self.warp.at_rest == self.mujoco.at_rest


def measure_speed(
    scenes: Sequence[Scene], worlds: Sequence[int], device: str | None, exported: bool
) -> Iterator[WarpSpeed]:
    """Measure batches of so many worlds, the scenes repeated in turn."""
    warp, _ = import_warp()
    for count in worlds:
        batch = WarpBatch([scenes[k % len(scenes)] for k in range(count)], device=device, exported_settings=exported)
        batch.step(2)
        warp.synchronize()
        done, started = 0, time.perf_counter()
        while (passed := time.perf_counter() - started) < _TIMED_S:
            batch.step(10)
            warp.synchronize()
            done += 10
        place, full = str(batch.data.qpos.device), int(batch.overflowed().sum())
        different = min(count, len(scenes))
        yield WarpSpeed(count, different, place, count * done / passed, batch.nconmax, batch.njmax, full)


def measure_agreement(
    path: str, scene_ids: Sequence[str], duration_s: float, device: str | None, exported: bool, jobs: int
) -> Iterator[EngineAgreement]:
    """Step each scene of a dataset in both engines; MuJoCo always has the scene's own settings.

    Scenes of similar size share a batch, so they come in the order of their numbers of objects.
    """
    scenes = sorted(
        (_open_dataset(path).scene(scene_id) for scene_id in scene_ids),
        key=lambda scene: (scene.row["n_objects"], scene.scene_id),
    )
    for first in range(0, len(scenes), SCENES_PER_BATCH):
        group = scenes[first : first + SCENES_PER_BATCH]
        warp = measure_warp_drift(group, duration_s, device, exported)
        work = partial(_measure_in_mujoco, path, duration_s)
        mujoco = parallel_map(work, [scene.scene_id for scene in group], jobs, "simulates scenes")
        yield from map(EngineAgreement, warp, mujoco)


def _measure_in_mujoco(path: str, duration_s: float, scene_id: str) -> EngineDrift:
    return measure_mujoco_drift(_open_dataset(path).scene(scene_id), duration_s)


@lru_cache(maxsize=1)  # once per process
def _open_dataset(path: str) -> Dataset:
    return open_dataset(path)
