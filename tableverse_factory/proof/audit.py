"""The trajectories of one scene against what their rows claim: each is replayed from its own arrays, and compared."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from tableverse_factory.errors import TableverseError
from tableverse_factory.proof.arrays import Recording, read_arrays
from tableverse_factory.proof.replay import Replay, named_arm, replayed
from tableverse_factory.robots.arm import Arm
from tableverse_factory.robots.station import Station
from tableverse_factory.text import printable

OBJECT_TOLERANCE_M = 0.005
ARM_TOLERANCE_RAD = 0.01
"""What another machine's arithmetic may change; on the machine that made the trajectory a replay is equal."""

_EXACT = 1e-9
"""Of what is written twice, in the row and in the arrays."""


@dataclass(frozen=True, slots=True)
class TrajectoryAudit:
    """What was found of one trajectory that has arrays.

    Attributes:
        success: What its row claims.
        reproduced: Whether the replay ended in the same way, in success or not.
        object_m: Largest distance of the carried object from where it was recorded [m].
        arm_rad: Largest distance of a joint from where it was recorded [rad].
        problems: One line each; empty when all is well.
    """

    task_id: str
    success: bool
    reproduced: bool
    object_m: float | None
    arm_rad: float | None
    problems: tuple[str, ...]


def audit_trajectories(
    files: Mapping[str, bytes], rows: Iterable[Mapping[str, Any]], arm: Arm | None = None
) -> tuple[TrajectoryAudit, ...]:
    """Replays every trajectory of a scene that has arrays, or claims a success.

    Args:
        files: Of the scene by name.
        rows: Of trajectories/, of this scene.
        arm: The robot of those that came from a file.
    """
    stations: dict[str, Station] = {}
    claimed = [row for row in rows if row.get("arrays") is not None or row.get("success")]
    return tuple(_audit(files, row, stations, arm) for row in claimed)


def _audit(
    files: Mapping[str, bytes], row: Mapping[str, Any], stations: dict[str, Station], arm: Arm | None
) -> TrajectoryAudit:
    task_id, success, name = str(row.get("task_id")), bool(row.get("success")), str(row.get("arrays"))
    if name not in files:
        return TrajectoryAudit(task_id, success, False, None, None, (f"there is no {printable(name, 100)} to replay",))
    try:
        saved = read_arrays(files[name], name)
        if saved.robot not in stations:
            given = arm is not None and saved.robot.endswith(".xml")
            stations[saved.robot] = Station(files, arm if arm is not None and given else named_arm(saved.robot))
        replay = replayed(files, row, saved, stations[saved.robot])
    except TableverseError as error:
        return TrajectoryAudit(task_id, success, False, None, None, (str(error),))
    object_m, arm_rad = replay.difference()
    reproduced = replay.verdict.success == success
    problems = (*_outcome(row, replay), *_states(replay, object_m, arm_rad), *_claims(row, saved))
    return TrajectoryAudit(task_id, success, reproduced, object_m, arm_rad, problems)


def _outcome(row: Mapping[str, Any], replay: Replay) -> Iterator[str]:
    verdict = replay.verdict
    if row.get("success") and not verdict.success:
        yield f"a success by its row; replayed it fails in {verdict.failed_phase}: {verdict.reason}: {verdict.detail}"
    elif verdict.success and not row.get("success"):
        yield f"a failure by its row ({row.get('reason')!r:.60}); replayed it succeeds"
    for key in ("lifted_m", "disturbed_m"):
        claimed, found = row.get(key), getattr(verdict, key)
        if claimed is not None and not abs(claimed - found) <= OBJECT_TOLERANCE_M:
            yield f"{key}: {claimed:.4f} by its row, {found:.4f} replayed"


def _states(replay: Replay, object_m: float, arm_rad: float) -> Iterator[str]:
    if not object_m <= OBJECT_TOLERANCE_M:
        yield f"replayed the object is {1e3 * object_m:.1f} mm from where it was recorded"
    if not arm_rad <= ARM_TOLERANCE_RAD:
        yield f"replayed a joint is {arm_rad:.3f} rad from where it was recorded"
    if len(replay.saved) != len(replay.now):
        yield f"{len(replay.saved)} samples are recorded; replayed it ends after {len(replay.now)}"


def _claims(row: Mapping[str, Any], saved: Recording) -> Iterator[str]:
    """What stands in the row and in the arrays has to be the same."""
    if row.get("robot") is not None and row["robot"] != saved.robot:
        yield f"its row says robot {row['robot']!r:.60}, its arrays {saved.robot!r:.60}"
    place = [row.get(key) for key in ("base_x_m", "base_y_m", "base_z_m")]
    if None not in place and not np.allclose(np.array(place, dtype=np.float64), saved.base.position, 0.0, _EXACT):
        yield f"its row puts the base at {place!r:.100}, its arrays at {saved.base.position.tolist()}"
