"""Search for one task's trajectory over grasp stages, bases and placements, until a motion succeeds in physics."""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

import numpy as np

from schemas.curation import Relation
from schemas.geometry import Frozen, Pose
from schemas.trajectories import Grasps, Motion, NoMotion, Phase, Placement
from tableverse_factory.geometry.math.transforms import (
    compose_poses,
    invert_pose,
    quaternion_from_matrix,
    rotation_matrix,
    transform_points,
)
from tableverse_factory.robotics.execution.execute import RolloutResult, execute_and_check
from tableverse_factory.robotics.execution.goal import Goal, load_goal
from tableverse_factory.robotics.execution.perturbations import find_survived_perturbations
from tableverse_factory.robotics.grasps.arbitration import HEMISPHERE, STRICT, arbitrate
from tableverse_factory.robotics.grasps.clearance import Mask
from tableverse_factory.robotics.motion.phases import plan_motion
from tableverse_factory.robotics.placements.request import NoPlacement
from tableverse_factory.robotics.placements.sampling import sample_placements
from tableverse_factory.stages.trajectories.work_cell import WorkCell

MAX_GRASPS = 16  # grasps tried per stage: the best, and those that differ most from them
# Grasps nearer than this and turned by less than 20 degrees are alike: they fail together
ALIKE_M, ALIKE_COS = 0.015, 0.94
# Failures in these phases do not depend on the placement
GRASP_PHASES = (Phase.PRE_GRASP, Phase.GRASP, Phase.POST_GRASP)
MAX_REASONS = 5  # reasons named in the tally of a task's attempts
_PHASES = tuple(Phase)
_TARGET_GRASPS = 3  # best grasps that a base has to reach, beside the best one at the best placement


@dataclass(frozen=True, slots=True, eq=False)
class Attempt(Frozen):
    """Tried pair of grasp and placement."""

    base: Pose  # of the robot, in the table frame
    stage: int  # of the paper's arbitration, 1 to 3
    score: float  # of the grasp
    failed_phase: str  # empty on success
    reason: str  # code; empty on success
    detail: str
    motion: Motion | None = None
    proof: RolloutResult | None = None
    fallbacks: tuple[str, ...] = ()  # compromises of the placement and the motion, in words

    @property
    def success(self) -> bool:
        """Whether the motion succeeded in physics."""
        return self.proof is not None and self.proof.verdict.success

    @property
    def progress(self) -> tuple[bool, int]:
        """Rank of the attempt: executed or only planned, and up to which phase."""
        return self.proof is not None, next((i for i, name in enumerate(_PHASES) if name == self.failed_phase), -1)


@dataclass(frozen=True, slots=True, eq=False)
class PlannedTask:
    """Result of a task."""

    attempt: Attempt | None = None  # the successful one, or the first of those that came furthest
    reason: str = ""  # code of what prevented any attempt; empty where there was one
    detail: str = ""  # what prevented any attempt, or a tally of failures
    candidates: int = 0  # number of grasps with clearance
    tried: int = 0  # number of attempts
    survives: tuple[str, ...] = ()  # perturbations under which it succeeds too


class _PlaceClearance:
    """Gripper clearance of grasps at each placement, computed lazily."""

    def __init__(self, cell: WorkCell, object_id: str, grasps: Grasps, places: tuple[Placement, ...]) -> None:
        self.cell, self.grasps, self.places, self._object_id = cell, grasps, places, object_id
        self._known: dict[int, Mask] = {}

    def at(self, place: int) -> Mask:
        """Test whether each grasp has clearance at a placement. Shape (n,)."""
        if place not in self._known:
            standing = self.cell.objects[self._object_id].pose
            motion = compose_poses(self.places[place].pose, invert_pose(standing))
            self._known[place] = self.cell.has_room(self._object_id, move_grasps(self.grasps, motion))
        return self._known[place]

    def anywhere(self) -> Mask:
        """Test which grasps have clearance at any placement. Shape (n,)."""
        return np.any([self.at(place) for place in range(len(self.places))], axis=0)


def search_trajectory(cell: WorkCell, task: Mapping[str, Any], rng: np.random.Generator) -> PlannedTask:
    """Search a successful trajectory for a row of tasks/, and what it survives, or return how far it came."""
    goal = load_goal(cell.files, task, cell.config.max_disturbed_m)
    found = search_motion(cell, goal, rng)
    best = found.attempt
    if best is None or not best.success or best.motion is None:
        return found
    return replace(found, survives=find_survived_perturbations(cell.station, best.base, best.motion, goal))


def search_motion(cell: WorkCell, goal: Goal, rng: np.random.Generator) -> PlannedTask:
    """Search a motion that reaches a goal in simulation, or return how far it came."""
    config = cell.config
    x, y = cell.objects[goal.x_id], cell.objects[goal.y_id]
    others = [scene_object for name, scene_object in cell.objects.items() if name not in (goal.x_id, goal.y_id)]
    places = sample_placements(Relation(goal.relation), x, y, others, cell.table, config, rng)
    if isinstance(places, NoPlacement):
        return PlannedTask(reason=places.reason, detail=places.detail)
    grasps = cell.grasps(goal.x_id)
    if not len(grasps):
        return PlannedTask(reason="no_grasp", detail=f"no grasp of {goal.x_id} leaves room for the gripper")
    best, reasons = None, Counter[str]()
    for attempt in islice(_iterate_attempts(cell, goal, grasps, places, rng), config.tries):
        reasons[attempt.reason] += 1
        if best is None or attempt.success or attempt.progress > best.progress:
            best = attempt
        if attempt.success:
            break
    if best is None:
        detail = "no base reaches both ends with a grasp that leaves the gripper room where the object is to go"
        return PlannedTask(reason="no_base_or_room", detail=detail, candidates=len(grasps))
    tally = "" if best.success else format_tally(reasons)
    return PlannedTask(best, detail=tally, candidates=len(grasps), tried=reasons.total())


def format_tally(reasons: Counter[str]) -> str:
    """Count failed attempts by reason, the most frequent first, in one short line."""
    ranked = sorted(reasons.items(), key=lambda item: (-item[1], item[0]))
    named = [f"{count} {reason}" for reason, count in ranked[:MAX_REASONS]]
    rest = sum(count for _, count in ranked[MAX_REASONS:])
    tries = reasons.total()
    return f"{tries} {'try' if tries == 1 else 'tries'}: {', '.join([*named, f'{rest} others'] if rest else named)}"


def _iterate_attempts(
    cell: WorkCell, goal: Goal, grasps: Grasps, places: tuple[Placement, ...], rng: np.random.Generator
) -> Iterator[Attempt]:
    """Iterate attempts in the order of the stages; each base gets its share of the tries."""
    standing = cell.objects[goal.x_id].pose
    for stage, chosen in split_by_stage(grasps, cell.config.gamma_strict):
        room = _select_with_clearance(cell, goal.x_id, chosen, places)
        if not len(room.grasps):
            continue
        best_in_object = transform_points(invert_pose(standing), room.grasps.positions[:1])
        best_placed = transform_points(places[0].pose, best_in_object)
        where = cell.bases(np.concatenate([room.grasps.positions[:_TARGET_GRASPS], best_placed]))
        share = max(1, -(-cell.config.tries // max(1, len(where))))
        slipped: set[int] = set()
        for base in where:
            yield from islice(_iterate_from_base(room, base, goal, stage, slipped, rng), share)


def _iterate_from_base(
    room: _PlaceClearance, base: Pose, goal: Goal, stage: int, slipped: set[int], rng: np.random.Generator
) -> Iterator[Attempt]:
    """Iterate pairs, the best of both first, skipping grasps that failed before the transfer.

    Grasps that lost the object in physics are added to `slipped`, as they would from any other base.
    """
    cell, grasps, places = room.cell, room.grasps, room.places
    world, standing = cell.world(base), cell.objects[goal.x_id].pose
    home = cell.station.arm.home
    hopeless = set(slipped)
    for index, place in _iterate_pairs(len(grasps), len(places)):
        if index in hopeless or not room.at(place)[index]:
            continue
        tcp_grasp = Pose(grasps.positions[index].copy(), quaternion_from_matrix(grasps.rotations[index]))
        tcp_place = compose_poses(places[place].pose, compose_poses(invert_pose(standing), tcp_grasp))
        score, width = float(grasps.scores[index]), float(grasps.widths[index])
        motion = plan_motion(world, home, tcp_grasp, tcp_place, goal.x_id, width, cell.config, rng, cell.planner)
        if isinstance(motion, NoMotion):
            attempt = Attempt(base, stage, score, motion.phase, motion.reason, motion.detail)
        else:
            proof = execute_and_check(cell.station, base, motion, goal)
            said = proof.verdict
            by = places[place].clear_by
            settled = motion.fallbacks if by == "boxes" else (f"{Phase.PLACE}: clear by {by}", *motion.fallbacks)
            attempt = Attempt(base, stage, score, said.failed_phase, said.reason, said.detail, motion, proof, settled)
        yield attempt
        if attempt.failed_phase in GRASP_PHASES:
            hopeless.add(index)
            if attempt.proof is not None and attempt.reason == "slipped":
                slipped.add(index)


def _select_with_clearance(
    cell: WorkCell, object_id: str, stage: Grasps, places: tuple[Placement, ...]
) -> _PlaceClearance:
    """Select diverse grasps of a stage; if none has clearance, diverse ones of those that have.

    Most vessels leave a hand so little room that few grasps can release in them, and seldom the best.
    """
    room = _PlaceClearance(cell, object_id, select_diverse(stage), places)
    if any(room.at(place).any() for place in range(len(places))):
        return room
    roomy = np.flatnonzero(_PlaceClearance(cell, object_id, stage, places).anywhere()).astype(np.int32)
    return _PlaceClearance(cell, object_id, select_diverse(stage.select(roomy)), places)


def move_grasps(grasps: Grasps, motion: Pose) -> Grasps:
    """Move grasps along with their object, within the table frame."""
    rotations = rotation_matrix(motion.quaternion_wxyz) @ grasps.rotations
    return replace(grasps, rotations=rotations, positions=transform_points(motion, grasps.positions))


def split_by_stage(grasps: Grasps, gamma_strict: float) -> Iterator[tuple[int, Grasps]]:
    """Split grasps into the paper's stages, each without those of earlier stages."""
    left = grasps
    while len(left):
        chosen, stage = arbitrate(left, gamma_strict)
        yield stage, chosen
        down = left.rotations[:, 2, 2]
        rest = {STRICT: down > gamma_strict, HEMISPHERE: down >= 0.0}.get(stage)
        if rest is None:
            return
        left = left.select(np.flatnonzero(rest).astype(np.int32))


def select_diverse(grasps: Grasps) -> Grasps:
    """Select at most `MAX_GRASPS`, in order, only the first of alike ones."""
    kept: list[int] = []
    for index in range(len(grasps)):
        near = np.linalg.norm(grasps.positions[kept] - grasps.positions[index], axis=1) < ALIKE_M
        along = grasps.rotations[kept] * grasps.rotations[index]
        cosines = along.sum(axis=1)  # of the angles between the axes of both frames
        alike = near & (cosines[:, 2] > ALIKE_COS) & (np.abs(cosines[:, 1]) > ALIKE_COS)
        if not alike.any():
            kept.append(index)
        if len(kept) == MAX_GRASPS:
            break
    return grasps.select(np.array(kept, dtype=np.int32))


def _iterate_pairs(grasps: int, places: int) -> Iterator[tuple[int, int]]:
    """Iterate all pairs by the sum of their ranks."""
    for total in range(grasps + places - 1):
        for grasp in range(max(0, total - places + 1), min(grasps, total + 1)):
            yield grasp, total - grasp
