"""CPU time of trajectories by part, and success rates by relation."""

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from schemas.config import Config
from schemas.curation import Relation
from schemas.geometry import Pose
from schemas.scene import ExportedScene
from schemas.trajectories import JointPath, JointVector, Motion, Phase
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.bench.measurement import Stopwatch
from tableverse_factory.geometry.relations.relations import measure_outline_gap
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.execution.execute import execute_and_check
from tableverse_factory.robotics.execution.goal import Goal, load_goal
from tableverse_factory.robotics.execution.perturbations import PERTURBATIONS, find_survived_perturbations
from tableverse_factory.robotics.motion.kinematics import solve_ik
from tableverse_factory.robotics.motion.phases import plan_motion
from tableverse_factory.robotics.motion.retime import retime_curve
from tableverse_factory.robotics.motion.rrt import RrtConnect
from tableverse_factory.robotics.motion.segments import blend_path, compute_arc_lengths
from tableverse_factory.robotics.motion.validate import validate_motion
from tableverse_factory.robotics.motion.world import CollisionSpace, CollisionWorld
from tableverse_factory.robotics.placements.sampling import sample_placements
from tableverse_factory.robotics.robots.registry import load_arm
from tableverse_factory.stages.trajectories.search import Attempt, search_trajectory
from tableverse_factory.stages.trajectories.work_cell import WorkCell

BLEND_RAD = 0.12  # blend radius of the paths that are timed [rad]

FREE_M, BESIDE_M = 0.02, 0.01
"""An object is free if no other within `FREE_M` of its outline rises `BESIDE_M` above its lowest point [m]."""

WHOLE, PLANNING, IK, PATH, TIMING = "whole", "plan", "ik", "path", "parameterisation"
PLACES, GRASPS, RECHECK, ROLLOUT, CHANGED = "placements", "grasps", "recheck", "rollout", "four changed rollouts"


@dataclass(slots=True)
class TaskCost:
    """Cost and outcome of one task."""

    scene_id: str
    task_id: str
    relation: str
    free: bool = False  # whether no other object at its height stands within `FREE_M` of the object
    ended: str = ""  # empty for a success, else the reason of the failure
    tried: int = 0  # pairs of grasp and placement that were tried
    survives: tuple[str, ...] = ()  # perturbations under which it succeeds too
    cpu_s: dict[str, float] = field(default_factory=dict)  # by part reached; of paths, IK and timing per problem [s]
    path_lengths_rad: list[float | None] = field(default_factory=list)  # by problem of the planner; None if unsolved


def bench_trajectories(
    scenes: Sequence[ExportedScene],
    config: Config,
    services: Services,
    most: int | None = None,
    on_task: Callable[[], object] = lambda: None,
) -> list[TaskCost]:
    """Solve every accepted task, at most `most` per scene, as the stage does; then measure its parts one by one."""
    arm = load_arm(config.trajectories.robot)
    costs = []
    for scene in scenes:
        for_things, for_tasks = make_rng(config.run.seed, scene.scene_id, "trajectories").spawn(2)
        cell = WorkCell(dict(scene.files), scene.object_rows, arm, config.trajectories, for_things, services)
        tasks = [row for row in scene.task_rows if row["accepted"]][: config.trajectories.max_tasks]
        for task, rng in list(zip(tasks, for_tasks.spawn(len(tasks)), strict=True))[:most]:
            costs.append(_measure_task(cell, task, config, rng))
            on_task()
    return costs


def _measure_task(cell: WorkCell, task: Mapping[str, Any], config: Config, rng: np.random.Generator) -> TaskCost:
    cost = TaskCost(str(task["scene_id"]), str(task["task_id"]), str(task["relation"]))
    watch = Stopwatch()
    cost.cpu_s = watch.cpu_s
    with watch.measure(GRASPS):
        cell.grasps(str(task["x_id"]))
    with watch.measure(WHOLE):
        found = search_trajectory(cell, task, rng)
    cost.cpu_s[WHOLE] += cost.cpu_s[GRASPS]
    cost.tried, cost.survives = found.tried, found.survives
    attempt = found.attempt
    cost.ended = found.reason if attempt is None else attempt.reason
    goal = load_goal(cell.files, task, config.trajectories.max_disturbed_m)
    cost.free = _is_free(cell, goal.x_id)
    others = [thing for name, thing in cell.objects.items() if name not in (goal.x_id, goal.y_id)]
    with watch.measure(PLACES):
        x, y = cell.objects[goal.x_id], cell.objects[goal.y_id]
        sample_placements(Relation(goal.relation), x, y, others, cell.table, config.trajectories, rng)
    if attempt is not None and attempt.motion is not None:
        _measure_parts(cell, goal, attempt, attempt.motion, config, rng, cost, watch)
    return cost


def _is_free(cell: WorkCell, object_id: str) -> bool:
    x = cell.objects[object_id].body
    others = [thing.body for name, thing in cell.objects.items() if name != object_id]
    return all(body.high[2] <= x.low[2] + BESIDE_M or measure_outline_gap(x, body) >= FREE_M for body in others)


def _measure_parts(
    cell: WorkCell,
    goal: Goal,
    attempt: Attempt,
    motion: Motion,
    config: Config,
    rng: np.random.Generator,
    cost: TaskCost,
    watch: Stopwatch,
) -> None:
    """Measure the parts of a motion again, for its known pair of grasp and placement."""
    settings, world, home = config.trajectories, cell.world(attempt.base), cell.station.arm.home
    tcp_grasp, tcp_place = (
        world.tcp(motion.positions[_find_last_index(motion, phase)]) for phase in (Phase.GRASP, Phase.PLACE)
    )
    width = _find_grasp_width(cell, goal.x_id, tcp_grasp)
    planner = _RecordingPlanner()
    with watch.measure(PLANNING):
        plan_motion(world, home, tcp_grasp, tcp_place, goal.x_id, width, settings, rng, planner)
    with watch.measure(RECHECK):
        validate_motion(world, motion, goal.x_id, width, settings)
    with watch.measure(ROLLOUT):
        execute_and_check(cell.station, attempt.base, motion, goal)
    if attempt.success:
        with watch.measure(CHANGED):
            find_survived_perturbations(cell.station, attempt.base, motion, goal)
    with watch.measure(IK, 2):
        for tcp in (tcp_grasp, tcp_place):
            solve_ik(world.chain, world.in_base(tcp), home, 8)
    _measure_paths(world, planner.problems, config, rng, cost, watch)


def _measure_paths(
    world: CollisionWorld,
    problems: Sequence[tuple[JointVector, JointVector, CollisionSpace]],
    config: Config,
    rng: np.random.Generator,
    cost: TaskCost,
    watch: Stopwatch,
) -> None:
    """Solve the planner's problems again; measure planning and timing of each path."""
    planner, settings, arm = RrtConnect(), config.trajectories, world.station.arm
    for start, goal, space in problems:
        with watch.measure(PATH, len(problems)):
            path = planner.plan_path(start, goal, space, rng)
        cost.path_lengths_rad.append(None if path is None else float(compute_arc_lengths(path)[-1]))
        if path is not None:
            world.dynamics.set_payload(world.station, space.carried)
            with watch.measure(TIMING, len(problems)):
                curve = blend_path(path, BLEND_RAD, touch_at_start=False, touch_at_end=False)
                retime_curve(curve, arm, world.dynamics, settings.speed, settings.step_s)


class _RecordingPlanner(RrtConnect):
    """Planner that records its problems."""

    def __init__(self) -> None:
        self.problems: list[tuple[JointVector, JointVector, CollisionSpace]] = []

    def plan_path(
        self, start: JointVector, goal: JointVector, space: CollisionSpace, rng: np.random.Generator
    ) -> JointPath | None:
        """Plan as `Planner.plan_path` does."""
        self.problems.append((start, goal, space))
        return super().plan_path(start, goal, space, rng)


def _find_grasp_width(cell: WorkCell, object_id: str, tcp: Pose) -> float:
    """Find the distance between the contacts of the grasp nearest to `tcp` [m]."""
    grasps = cell.grasps(object_id)
    nearest = int(np.argmin(np.linalg.norm(grasps.positions - tcp.position, axis=1)))
    return float(grasps.widths[nearest])


def _find_last_index(motion: Motion, phase: Phase) -> int:
    return int(np.flatnonzero(motion.phases == list(Phase).index(phase))[-1])


@dataclass(frozen=True, slots=True)
class OutcomeCounts:
    """Outcomes of tasks, by relation unless stated."""

    tasks: Mapping[str, int]
    succeeded: Mapping[str, int]
    free: Mapping[str, int]  # tasks whose object is free
    free_succeeded: Mapping[str, int]  # successes among these
    reasons: Mapping[str, int]  # failures by reason, most frequent first
    survived: Mapping[str, float]  # share of the successes that also succeed under each perturbation


ALL = "all"


def count_outcomes(costs: Sequence[TaskCost]) -> OutcomeCounts:
    """Count the outcomes of all tasks."""
    done = [cost for cost in costs if not cost.ended]
    share = {name: sum(name in cost.survives for cost in done) / len(done) for name in PERTURBATIONS} if done else {}
    reasons = dict(Counter(cost.ended for cost in costs if cost.ended).most_common())
    order = [*sorted({cost.relation for cost in costs}), ALL]

    def counted(some: Iterable[TaskCost]) -> dict[str, int]:
        found = Counter(name for cost in some for name in (cost.relation, ALL))
        return {name: found[name] for name in order}

    free = [cost for cost in costs if cost.free]
    return OutcomeCounts(
        counted(costs), counted(done), counted(free), counted(c for c in free if not c.ended), reasons, share
    )


def compute_quantiles(costs: Sequence[TaskCost]) -> dict[str, tuple[int, float, float]]:
    """Compute, by part, the number of tasks that reached it, and median and 95th percentile of its CPU time [s]."""
    seconds: defaultdict[str, list[float]] = defaultdict(list)
    for cost in costs:
        for name, spent in cost.cpu_s.items():
            seconds[name].append(spent)
    order = (WHOLE, GRASPS, PLACES, PLANNING, IK, PATH, TIMING, RECHECK, ROLLOUT, CHANGED)
    return {
        name: (len(seconds[name]), float(np.median(seconds[name])), float(np.percentile(seconds[name], 95)))
        for name in order
        if seconds[name]
    }


def summarize_paths(costs: Sequence[TaskCost]) -> tuple[int, int, float]:
    """Count the planner's problems and those it solved; compute the median length of the paths [rad]."""
    problems = [length for cost in costs for length in cost.path_lengths_rad]
    solved = [length for length in problems if length is not None]
    return len(problems), len(solved), float(np.median(solved)) if solved else float("nan")
