"""Audit of a scene's trajectories: each is replayed from its own arrays and compared with its row."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from schemas.config import TrajectoriesConfig
from tableverse_factory.core.errors import InputError, TableverseError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.robotics.execution.arrays import decode_recording
from tableverse_factory.robotics.execution.check_row import Row, find_row_mismatches
from tableverse_factory.robotics.execution.execute import TOO_LONG
from tableverse_factory.robotics.execution.replay import Replay, ReplayDifference, load_named_arm, replay_recording
from tableverse_factory.robotics.robots.arm import Arm
from tableverse_factory.robotics.robots.station import Station

# Tolerances for another machine's arithmetic; on the machine that made the trajectory a replay is equal
OBJECT_TOLERANCE_M, OBJECT_TOLERANCE_RAD, ARM_TOLERANCE_RAD = 0.005, 0.1, 0.01


@dataclass(frozen=True, slots=True)
class TrajectoryAudit:
    """Findings about one trajectory with arrays."""

    task_id: str
    success: bool  # as its row claims
    reproduced: bool  # whether the replay ended in the same way, in success or not
    object_m: float | None  # largest distance of an object from its recorded position
    arm_rad: float | None  # largest distance of a joint from its recorded position
    problems: tuple[str, ...]  # one line each; empty if none


def audit_trajectories(
    files: Mapping[str, bytes],
    rows: Iterable[Row],
    arm: Arm | None = None,
    tasks: Sequence[Row] | None = None,
    config: TrajectoriesConfig | None = None,
) -> tuple[TrajectoryAudit, ...]:
    """Replay every row of trajectories/ of a scene that has arrays, or claims a success.

    `arm` is the robot where it came from a file, `tasks` the scene's rows of tasks/, None if unknown. Without `config`,
    that of the build, the bound on disturbances is taken from the arrays.
    """
    stations: dict[str, Station] = {}
    claimed = [row for row in rows if row.get("arrays") is not None or row.get("success")]
    return tuple(_audit_trajectory(files, row, stations, arm, tasks, config) for row in claimed)


def _audit_trajectory(
    files: Mapping[str, bytes],
    row: Row,
    stations: dict[str, Station],
    arm: Arm | None,
    tasks: Sequence[Row] | None,
    config: TrajectoriesConfig | None,
) -> TrajectoryAudit:
    task_id, success, name = str(row.get("task_id")), bool(row.get("success")), str(row.get("arrays"))
    try:
        if name not in files:
            raise InputError(f"there is no {sanitize_line(name, 100)} to replay", "bad_arrays")
        saved = decode_recording(files[name], name)
        if saved.robot not in stations:
            given = arm is not None and saved.robot.endswith(".xml")
            stations[saved.robot] = Station(files, arm if arm is not None and given else load_named_arm(saved.robot))
        bound = None if config is None else config.max_disturbed_m
        replay = replay_recording(files, row, saved, stations[saved.robot], bound)
    except TableverseError as error:
        return TrajectoryAudit(task_id, success, False, None, None, (str(error),))
    found = replay.compute_difference()
    reproduced = replay.verdict.success == success
    problems = (
        *_compare_outcome(row, replay),
        *_compare_states(replay, found),
        *find_row_mismatches(row, saved, tasks, config),
    )
    return TrajectoryAudit(task_id, success, reproduced, found.object_m, found.arm_rad, problems)


def _compare_outcome(row: Row, replay: Replay) -> Iterator[str]:
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


def _compare_states(replay: Replay, found: ReplayDifference) -> Iterator[str]:
    if strangers := [name for name in replay.saved.moved_ids if name not in replay.standing]:
        yield f"{strangers[0]} is recorded as moved, and is no other object of the scene"
    limits = (
        (found.object_m, OBJECT_TOLERANCE_M, f"an object is {1e3 * found.object_m:.1f} mm from where it was recorded"),
        (found.object_rad, OBJECT_TOLERANCE_RAD, f"an object is turned by {found.object_rad:.2f} rad"),
        (found.arm_rad, ARM_TOLERANCE_RAD, f"a joint is {found.arm_rad:.3f} rad from where it was recorded"),
        (found.tcp_m, OBJECT_TOLERANCE_M, f"the gripper is {1e3 * found.tcp_m:.1f} mm from where it was recorded"),
        (found.disturbed_m, OBJECT_TOLERANCE_M, f"displacements differ by {1e3 * found.disturbed_m:.1f} mm"),
    )
    yield from (f"replayed {problem}" for value, limit, problem in limits if not value <= limit)
    if len(replay.saved) != len(replay.now):
        yield f"{len(replay.saved)} samples are recorded; replayed it ends after {len(replay.now)}"
