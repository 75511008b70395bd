"""One task: stages of grasps, bases and placements in turn, until a motion is proven or patience ends."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from schemas.config import TrajectoriesConfig
from schemas.curation import Relation
from schemas.geometry import Frozen, Points, Pose
from schemas.trajectories import Grasps, Motion, NoMotion, Phase, Placement
from tableverse_factory.geometry.math.transforms import (
    compose,
    inverse,
    quaternion_from_matrix,
    rotation_matrix,
    transform_points,
)
from tableverse_factory.robotics.execution.execute import Proof, execute_and_check
from tableverse_factory.robotics.execution.goal import Goal, goal_of
from tableverse_factory.robotics.execution.perturbations import robust_to
from tableverse_factory.robotics.grasps.arbitration import HEMISPHERE, STRICT, arbitrate
from tableverse_factory.robotics.grasps.clearance import Mask
from tableverse_factory.robotics.motion.phases import plan
from tableverse_factory.robotics.placements.request import NoPlacement
from tableverse_factory.robotics.placements.sampling import placements
from tableverse_factory.stages.trajectories.work_cell import WorkCell

MOST_GRASPS = 16
"""Of a stage: the best, and those that differ most from them."""

ALIKE_M, ALIKE_COS = 0.015, 0.94
"""Grasps that are nearer than this and turned by less than 20 degrees share their fate."""

BEFORE_THE_GOAL = (Phase.PRE_GRASP, Phase.GRASP, Phase.POST_GRASP)
"""What fails in these fails wherever the object is to go."""

MOST_REASONS = 5
"""That are named in the tally of a task's attempts."""

_PHASES = tuple(Phase)
_REACHES = 3


@dataclass(frozen=True, slots=True, eq=False)
class Attempt(Frozen):
    """A pair of grasp and placement that was tried.

    Attributes:
        base: Of the robot, in the table frame.
        stage: Of the paper's arbitration, 1 to 3.
        score: Of the grasp.
        failed_phase: Where it went wrong; empty in success.
        reason: Code; empty in success.
        detail: One line for people.
        motion: None where none was found.
        proof: What physics said of the motion.
        fallbacks: What the placement and the motion settled for, in words.
    """

    base: Pose
    stage: int
    score: float
    failed_phase: str
    reason: str
    detail: str
    motion: Motion | None = None
    proof: Proof | None = None
    fallbacks: tuple[str, ...] = ()

    @property
    def success(self) -> bool:
        """Whether physics agreed."""
        return self.proof is not None and self.proof.verdict.success

    @property
    def progress(self) -> tuple[bool, int]:
        """How far it came: executed or only planned, and up to which phase."""
        return self.proof is not None, next((i for i, name in enumerate(_PHASES) if name == self.failed_phase), -1)


@dataclass(frozen=True, slots=True, eq=False)
class PlannedTask:
    """How a task ended.

    Attributes:
        attempt: The one that succeeded, or the first of those that came furthest; None where nothing could be tried.
        reason: Code of what stood in the way of any attempt; empty where there was one.
        detail: One line for people: what stood in the way of any attempt, or why how many of them failed.
        candidates: Grasps that have room.
        tried: Attempts.
        survives: Names of the changes of friction and mass under which it succeeds too.
    """

    attempt: Attempt | None = None
    reason: str = ""
    detail: str = ""
    candidates: int = 0
    tried: int = 0
    survives: tuple[str, ...] = ()


def search(
    cell: WorkCell, task: Mapping[str, Any], config: TrajectoriesConfig, rng: np.random.Generator
) -> PlannedTask:
    """A proven trajectory for a task, or how far it came.

    Args:
        cell: The scene and the arm.
        task: Row of tasks/.
        config: Bounds.
        rng: For placements and paths.

    Raises:
        TableverseError: if the scene does not hold what the task names, or a model does not answer.
    """
    goal = goal_of(cell.files, task, config.max_disturbed_m)
    x, y = cell.things[goal.x_id], cell.things[goal.y_id]
    others = [thing for name, thing in cell.things.items() if name not in (goal.x_id, goal.y_id)]
    places = placements(Relation(goal.relation), x, y, others, cell.table, config, rng)
    if isinstance(places, NoPlacement):
        return PlannedTask(reason=places.reason, detail=places.detail)
    grasps = cell.grasps(goal.x_id)
    if not len(grasps):
        return PlannedTask(reason="no_grasp", detail=f"no grasp of {goal.x_id} leaves room for the gripper")
    best, reasons = None, Counter[str]()
    for attempt in islice(_attempts(cell, goal, grasps, places, config, rng), config.tries):
        reasons[attempt.reason] += 1
        if best is None or attempt.success or attempt.progress > best.progress:
            best = attempt
        if attempt.success:
            break
    if best is None:
        detail = "no base reaches both ends with a grasp that leaves the gripper room where the object is to go"
        return PlannedTask(reason="no_base_or_room", detail=detail, candidates=len(grasps))
    survives: tuple[str, ...] = ()
    if best.success and best.motion is not None:
        survives = robust_to(cell.station, best.base, best.motion, goal)
    tally = "" if best.success else tally_of(reasons)
    return PlannedTask(best, detail=tally, candidates=len(grasps), tried=reasons.total(), survives=survives)


def tally_of(reasons: Counter[str]) -> str:
    """How many attempts failed of what, the most frequent first, in one short line."""
    ranked = sorted(reasons.items(), key=lambda item: (-item[1], item[0]))
    named = [f"{count} {reason}" for reason, count in ranked[:MOST_REASONS]]
    rest = sum(count for _, count in ranked[MOST_REASONS:])
    tries = reasons.total()
    return f"{tries} {'try' if tries == 1 else 'tries'}: {', '.join([*named, f'{rest} others'] if rest else named)}"


def _attempts(
    cell: WorkCell,
    goal: Goal,
    grasps: Grasps,
    places: tuple[Placement, ...],
    config: TrajectoriesConfig,
    rng: np.random.Generator,
) -> Iterator[Attempt]:
    """Attempts in the order of the stages; in a stage every base has its share of the tries."""
    standing = cell.things[goal.x_id].pose
    for stage, chosen in stages(grasps, config.gamma_strict):
        room = _with_room(cell, goal.x_id, chosen, places)
        if not len(room.grasps):
            continue
        where = cell.bases(_targets(room.grasps, standing, places))
        share = max(1, -(-config.tries // max(1, len(where))))
        slipped: set[int] = set()
        for base in where:
            yield from islice(_from_base(cell, base, goal, stage, room, slipped, config, rng), share)


def _from_base(
    cell: WorkCell,
    base: Pose,
    goal: Goal,
    stage: int,
    room: "_Room",
    slipped: set[int],
    config: TrajectoriesConfig,
    rng: np.random.Generator,
) -> Iterator[Attempt]:
    """Pairs, the best of both first, but for grasps that have failed before the object was on its way.

    To `slipped` go those that lost the object in physics: they would from any other base.
    """
    grasps, places = room.grasps, room.places
    world, standing = cell.world(base), cell.things[goal.x_id].pose
    home = cell.station.arm.home
    hopeless = set(slipped)
    for index, place in _pairs(len(grasps), len(places)):
        if index in hopeless or not room.at(place)[index]:
            continue
        tcp_grasp = _gripper_pose(grasps, index)
        tcp_place = compose(places[place].pose, compose(inverse(standing), tcp_grasp))
        score, width = float(grasps.scores[index]), float(grasps.widths[index])
        motion = plan(world, home, tcp_grasp, tcp_place, goal.x_id, width, config, rng, cell.planner)
        if isinstance(motion, NoMotion):
            attempt = Attempt(base, stage, score, motion.phase, motion.reason, motion.detail)
        else:
            proof = execute_and_check(cell.station, base, motion, goal)
            said = proof.verdict
            settled = (*room.settled_for(place), *motion.fallbacks)
            attempt = Attempt(base, stage, score, said.failed_phase, said.reason, said.detail, motion, proof, settled)
        yield attempt
        if attempt.failed_phase in BEFORE_THE_GOAL:
            hopeless.add(index)
            if attempt.proof is not None and attempt.reason == "slipped":
                slipped.add(index)


class _Room:
    """With which grasps the gripper has room where the object is let go, looked at place by place."""

    def __init__(self, cell: WorkCell, object_id: str, grasps: Grasps, places: tuple[Placement, ...]) -> None:
        self.grasps, self.places = grasps, places
        self._cell, self._object_id = cell, object_id
        self._known: dict[int, Mask] = {}

    def at(self, place: int) -> Mask:
        """Whether each grasp has room at a place. Shape (n,)."""
        if place not in self._known:
            standing = self._cell.things[self._object_id].pose
            motion = compose(self.places[place].pose, inverse(standing))
            self._known[place] = self._cell.has_room(self._object_id, moved(self.grasps, motion))
        return self._known[place]

    def anywhere(self) -> Mask:
        """Which grasps have room at any place. Shape (n,)."""
        found: Mask = np.any([self.at(place) for place in range(len(self.places))], axis=0)
        return found

    def settled_for(self, place: int) -> tuple[str, ...]:
        """What a place is worse in than the usual, in words."""
        by = self.places[place].clear_by
        return () if by == "boxes" else (f"{Phase.PLACE}: clear by {by}",)


def _with_room(cell: WorkCell, object_id: str, stage: Grasps, places: tuple[Placement, ...]) -> _Room:
    """What is tried of a stage: grasps that differ most; where none of those has room, the same of those that have.

    Most vessels leave a hand so little room that few grasps can let go in them, and seldom the best.
    """
    room = _Room(cell, object_id, diverse(stage), places)
    if any(room.at(place).any() for place in range(len(places))):
        return room
    roomy = np.flatnonzero(_Room(cell, object_id, stage, places).anywhere()).astype(np.int32)
    return _Room(cell, object_id, diverse(stage.chosen(roomy)), places)


def moved(grasps: Grasps, motion: Pose) -> Grasps:
    """The grasps carried along with what they hold, which is moved within the table frame."""
    rotations = rotation_matrix(motion.quaternion_wxyz) @ grasps.rotations
    return replace(grasps, rotations=rotations, positions=transform_points(motion, grasps.positions))


def stages(grasps: Grasps, gamma_strict: float) -> Iterator[tuple[int, Grasps]]:
    """The paper's stages, each with the grasps that no stage before had: where those fail, the next has its turn."""
    left = grasps
    while len(left):
        chosen, stage = arbitrate(left, gamma_strict)
        yield stage, chosen
        down = left.rotations[:, 2, 2]
        rest = {STRICT: down > gamma_strict, HEMISPHERE: down >= 0.0}.get(stage)
        if rest is None:
            return
        left = left.chosen(np.flatnonzero(rest).astype(np.int32))


def diverse(grasps: Grasps) -> Grasps:
    """At most `MOST_GRASPS`, in their order; of grasps that are alike only the first."""
    kept: list[int] = []
    for index in range(len(grasps)):
        near = np.linalg.norm(grasps.positions[kept] - grasps.positions[index], axis=1) < ALIKE_M
        along = grasps.rotations[kept] * grasps.rotations[index]
        cosines = along.sum(axis=1)  # of the angles between the axes of both frames
        alike = near & (cosines[:, 2] > ALIKE_COS) & (np.abs(cosines[:, 1]) > ALIKE_COS)
        if not alike.any():
            kept.append(index)
        if len(kept) == MOST_GRASPS:
            break
    return grasps.chosen(np.array(kept, dtype=np.int32))


def _pairs(grasps: int, places: int) -> Iterator[tuple[int, int]]:
    """All pairs, by the sum of their ranks."""
    for total in range(grasps + places - 1):
        for grasp in range(max(0, total - places + 1), min(grasps, total + 1)):
            yield grasp, total - grasp


def _targets(grasps: Grasps, standing: Pose, places: tuple[Placement, ...]) -> Points:
    """Where the TCP has to be: at the best grasps, and with the best of them at the best place."""
    picked = grasps.positions[:_REACHES]
    in_object = transform_points(inverse(standing), grasps.positions[:1])
    return np.concatenate([picked, transform_points(places[0].pose, in_object)])


def _gripper_pose(grasps: Grasps, index: int) -> Pose:
    return Pose(grasps.positions[index].copy(), quaternion_from_matrix(grasps.rotations[index]))
