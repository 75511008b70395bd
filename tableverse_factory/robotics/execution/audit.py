"""The trajectories of one scene against what their rows claim: each is replayed from its own arrays, and compared."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from schemas.config import TrajectoriesConfig
from tableverse_factory.core.errors import TableverseError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.robotics.execution.arrays import read_arrays
from tableverse_factory.robotics.execution.check_row import Row, row_mismatches
from tableverse_factory.robotics.execution.execute import TOO_LONG
from tableverse_factory.robotics.execution.replay import Difference, Replay, named_arm, replayed
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.station import Station

OBJECT_TOLERANCE_M = 0.005
OBJECT_TOLERANCE_RAD = 0.1
ARM_TOLERANCE_RAD = 0.01
"""What another machine's arithmetic may change; on the machine that made the trajectory a replay is equal."""


@dataclass(frozen=True, slots=True)
class TrajectoryAudit:
    """What was found of one trajectory that has arrays.

    Attributes:
        success: What its row claims.
        reproduced: Whether the replay ended in the same way, in success or not.
        object_m: Largest distance of an object from where it was recorded [m].
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
    files: Mapping[str, bytes],
    rows: Iterable[Row],
    arm: Arm | None = None,
    tasks: Sequence[Row] | None = None,
    config: TrajectoriesConfig | None = None,
) -> tuple[TrajectoryAudit, ...]:
    """Replays every trajectory of a scene that has arrays, or claims a success.

    Args:
        files: Of the scene by name.
        rows: Of trajectories/, of this scene.
        arm: The robot of those that came from a file.
        tasks: Rows of tasks/ of the scene; None where nobody knows what was asked.
        config: What the trajectories were made with; None where nobody knows it: the bound on disturbances that the
            arrays name is believed then.
    """
    stations: dict[str, Station] = {}
    claimed = [row for row in rows if row.get("arrays") is not None or row.get("success")]
    return tuple(_audit(files, row, stations, arm, tasks, config) for row in claimed)


def _audit(
    files: Mapping[str, bytes],
    row: Row,
    stations: dict[str, Station],
    arm: Arm | None,
    tasks: Sequence[Row] | None,
    config: TrajectoriesConfig | None,
) -> TrajectoryAudit:
    task_id, success, name = str(row.get("task_id")), bool(row.get("success")), str(row.get("arrays"))
    if name not in files:
        return TrajectoryAudit(
            task_id, success, False, None, None, (f"there is no {sanitize_line(name, 100)} to replay",)
        )
    try:
        saved = read_arrays(files[name], name)
        if saved.robot not in stations:
            given = arm is not None and saved.robot.endswith(".xml")
            stations[saved.robot] = Station(files, arm if arm is not None and given else named_arm(saved.robot))
        bound = None if config is None else config.max_disturbed_m
        replay = replayed(files, row, saved, stations[saved.robot], bound)
    except TableverseError as error:
        return TrajectoryAudit(task_id, success, False, None, None, (str(error),))
    found = replay.difference()
    reproduced = replay.verdict.success == success
    problems = (*_outcome(row, replay), *_states(replay, found), *row_mismatches(row, saved, tasks, config))
    return TrajectoryAudit(task_id, success, reproduced, found.object_m, found.arm_rad, problems)


def _outcome(row: Row, replay: Replay) -> Iterator[str]:
    verdict = replay.verdict
    if row.get("success") and not verdict.success:
        yield f"a success by its row; replayed it fails in {verdict.failed_phase}: {verdict.reason}: {verdict.detail}"
    elif verdict.success and not row.get("success"):
        yield f"a failure by its row ({row.get('reason')!r:.60}); replayed it succeeds"
    elif not verdict.success and row.get("reason") not in (verdict.reason, TOO_LONG):
        yield f"its row says {sanitize_line(repr(row.get('reason')), 60)}, replayed it fails with {verdict.reason!r}"
    for key in ("lifted_m", "disturbed_m"):
        claimed, found = row.get(key), getattr(verdict, key)
        if claimed is not None and not abs(claimed - found) <= OBJECT_TOLERANCE_M:
            yield f"{key}: {claimed:.4f} by its row, {found:.4f} replayed"


def _states(replay: Replay, found: Difference) -> Iterator[str]:
    if strangers := replay.strangers():
        yield f"{strangers[0]} is recorded as moved, and is no other object of the scene"
    if not found.object_m <= OBJECT_TOLERANCE_M:
        yield f"replayed an object is {1e3 * found.object_m:.1f} mm from where it was recorded"
    if not found.object_rad <= OBJECT_TOLERANCE_RAD:
        yield f"replayed an object is turned by {found.object_rad:.2f} rad from how it was recorded"
    if not found.arm_rad <= ARM_TOLERANCE_RAD:
        yield f"replayed a joint is {found.arm_rad:.3f} rad from where it was recorded"
    if not found.tcp_m <= OBJECT_TOLERANCE_M:
        yield f"replayed the gripper is {1e3 * found.tcp_m:.1f} mm from where it was recorded"
    if not found.disturbed_m <= OBJECT_TOLERANCE_M:
        yield f"replayed displacements differ by {1e3 * found.disturbed_m:.1f} mm from those that were recorded"
    if len(replay.saved) != len(replay.now):
        yield f"{len(replay.saved)} samples are recorded; replayed it ends after {len(replay.now)}"
