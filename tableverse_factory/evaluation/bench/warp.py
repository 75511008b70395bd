"""Speed of MuJoCo Warp on scenes of a dataset, and its agreement with MuJoCo."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.delivery.learning.vector_sim import compile_scene
from tableverse_factory.delivery.learning.warp import WarpBatch, import_warp
from tableverse_factory.evaluation.engine_drift import EngineDrift, measure_warp_drift
from tableverse_factory.physics.simulate.at_rest import measure_drift
from tableverse_factory.physics.simulate.certificate import DRIFT_LIMIT_M, DRIFT_LIMIT_RAD

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


@dataclass(frozen=True, slots=True)
class WarpAgreement:
    """What Warp and MuJoCo say of the same scenes, over the same time."""

    warp: tuple[EngineDrift, ...]
    mujoco_drift_m: tuple[float, ...]
    mujoco_at_rest: tuple[bool, ...]
    mujoco_contacts: tuple[int, ...]
    mujoco_penetration_m: tuple[float, ...]

    @property
    def agreeing(self) -> int:
        """Count the scenes of which both say the same about rest."""
        return sum(one.at_rest == rests for one, rests in zip(self.warp, self.mujoco_at_rest, strict=True))


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
        place = str(batch.data.qpos.device)
        yield WarpSpeed(count, min(count, len(scenes)), place, count * done / passed, batch.nconmax, batch.njmax)


def measure_agreement(scenes: Sequence[Scene], duration_s: float, device: str | None, exported: bool) -> WarpAgreement:
    """Step each scene in both engines and compare; MuJoCo always has the scene's own settings."""
    warp = measure_warp_drift(scenes, duration_s, device, exported)
    drifts, rests, contacts, depths = [], [], [], []
    for scene in scenes:
        model = compile_scene(scene, visuals=False)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        contacts.append(int(data.ncon))
        depths.append(float((-data.contact.dist).max(initial=0.0)))
        drift = measure_drift(model, duration_s)
        drifts.append(float(drift.distance_m.max(initial=0.0)))
        rests.append(bool(drifts[-1] <= DRIFT_LIMIT_M and np.max(drift.angle_rad, initial=0.0) <= DRIFT_LIMIT_RAD))
    return WarpAgreement(tuple(warp), tuple(drifts), tuple(rests), tuple(contacts), tuple(depths))
