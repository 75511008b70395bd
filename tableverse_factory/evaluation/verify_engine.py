"""Verification of a dataset in an engine that did not settle its scenes."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pyarrow.compute as pc

from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Scene, open_dataset
from tableverse_factory.evaluation.engine_drift import EngineDrift, measure_warp_drift
from tableverse_factory.evaluation.newton_drift import measure_newton_drift
from tableverse_factory.evaluation.scene_audit import SceneAudit
from tableverse_factory.physics.simulate.certificate import DRIFT_LIMIT_M, DRIFT_LIMIT_RAD, DRIFT_TIME_S, FALL_M


class Engine(NamedTuple):
    """An engine's name, how many scenes it steps at once, and what measures their drift."""

    name: str
    scenes_per_batch: int
    measure: Callable[[Sequence[Scene], float, str | None], list[EngineDrift]]


ENGINES = {
    "warp": Engine("MuJoCo Warp", 32, measure_warp_drift),
    "newton": Engine("Newton", 1, measure_newton_drift),
}


def verify_in_engine(path: str, engine: str, device: str | None = None) -> Iterator[SceneAudit]:
    """Measure rest and contacts of every finished scene of a dataset in one of `ENGINES`, for the certificate's time.

    Scenes of similar size share a batch, so they come in the order of their numbers of objects.
    """
    dataset = open_dataset(path)
    columns = ["scene_id", "n_objects", "epsilon_m"]
    rows = dataset.scenes.to_table(filter=pc.field("status") == "done", columns=columns).to_pylist()
    if not rows:
        raise InputError(f"{path}: no finished scene to verify; see `tableverse status {path}`")
    rows.sort(key=lambda row: (row["n_objects"], row["scene_id"]))
    name, size, measure = ENGINES[engine]
    for first in range(0, len(rows), size):
        group = rows[first : first + size]
        scenes = [dataset.scene(row["scene_id"]) for row in group]
        for row, found in zip(group, measure(scenes, DRIFT_TIME_S, device), strict=True):
            yield audit_engine(row, found, name)


def audit_engine(row: Mapping[str, Any], found: EngineDrift, engine: str) -> SceneAudit:
    """Compare what an engine measured with the certificate's limits and the scene's own bound of penetration."""
    problems = []
    if found.overflowed:
        problems.append(f"{engine} needed more contacts or constraints than it had room for")
    if found.drift_m > DRIFT_LIMIT_M or found.drift_rad > DRIFT_LIMIT_RAD:
        drift = f"{1e3 * found.drift_m:.2f} mm, {np.degrees(found.drift_rad):.2f} deg"
        problems.append(f"moved by {drift} within {DRIFT_TIME_S:g} s in {engine}")
    if found.sunk_m > FALL_M:
        problems.append(f"fell in {engine}")
    if found.penetration_m > row["epsilon_m"]:
        problems.append(f"pieces {1e3 * found.penetration_m:.2f} mm deep in {engine}")
    measured = {
        "piece_penetration_m": found.penetration_m,
        "drift_m": found.drift_m,
        "drift_rad": found.drift_rad,
        "contacts": found.contacts,
    }
    return SceneAudit(found.scene_id, measured, tuple(problems))
