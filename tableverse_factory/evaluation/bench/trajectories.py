"""What trajectories cost, part by part, and how many succeed; the planner beside OMPL's on the very same problems."""

import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from schemas.config import Config
from schemas.curation import Relation
from schemas.geometry import Pose
from schemas.scene import ExportedScene
from schemas.trajectories import JointPath, JointVector, Motion, Phase
from tableverse_factory.core.seeding import rng_for
from tableverse_factory.evaluation.bench.ompl_planner import OmplConnect, path_length
from tableverse_factory.geometry.relations.relations import outline_gap
from tableverse_factory.models.services import Services
from tableverse_factory.robotics.execution.execute import execute_and_check
from tableverse_factory.robotics.execution.goal import Goal, goal_of
from tableverse_factory.robotics.execution.perturbations import CHANGES, robust_to
from tableverse_factory.robotics.motion.blend import blended
from tableverse_factory.robotics.motion.interfaces import Planner
from tableverse_factory.robotics.motion.kinematics import solutions
from tableverse_factory.robotics.motion.phases import plan
from tableverse_factory.robotics.motion.retime import retimed
from tableverse_factory.robotics.motion.rrt import RrtConnect
from tableverse_factory.robotics.motion.validate import recheck
from tableverse_factory.robotics.motion.world import Space, World
from tableverse_factory.robotics.placements.sampling import placements
from tableverse_factory.robotics.robots.registry import arm_of
from tableverse_factory.stages.trajectories.search import Attempt, search
from tableverse_factory.stages.trajectories.work_cell import WorkCell

BLEND_RAD = 0.12
"""Radius of the blends of the curves that are timed."""

FREE_M, BESIDE_M = 0.02, 0.01
"""An object is free where nothing within this of its outline reaches higher than this above its lowest point."""

WHOLE, PLANNING, IK, PATH, OMPL, TIMING = "whole", "plan", "ik", "path", "path, OMPL", "parameterisation"
PLACES, GRASPS, RECHECK, ROLLOUT, CHANGED = "placements", "grasps", "recheck", "rollout", "four changed rollouts"


@dataclass(frozen=True, slots=True)
class Problem:
    """Two configurations between which a path was asked for, and how each planner did.

    Attributes:
        found: Whether there is one, by planner.
        length_rad: Of the path, by planner, where there is one [rad].
    """

    found: Mapping[str, bool]
    length_rad: Mapping[str, float]


@dataclass(slots=True)
class TaskCost:
    """One task.

    Attributes:
        free: Whether nothing else at the object's height stands within `FREE_M` of it.
        ended: Empty in success, else the reason.
        tried: Pairs of grasp and placement.
        survives: Changes under which it succeeds too.
        cpu_s: By part, where it was come to; paths, inverse kinematics and timings are means of one such problem [s].
        problems: Of the planner.
    """

    scene_id: str
    task_id: str
    relation: str
    free: bool = False
    ended: str = ""
    tried: int = 0
    survives: tuple[str, ...] = ()
    cpu_s: dict[str, float] = field(default_factory=dict)
    problems: list[Problem] = field(default_factory=list)


def bench_trajectories(
    scenes: Sequence[ExportedScene],
    config: Config,
    services: Services,
    ompl: bool,
    most: int | None = None,
    on_task: Callable[[], None] | None = None,
) -> list[TaskCost]:
    """Every task of the scenes as the stage does it, in this process; then its parts again, one by one.

    Args:
        scenes: As they were exported.
        config: `run.seed` and the section `trajectories`.
        services: For grasp models.
        ompl: Whether OMPL plans the same paths.
        most: At most so many tasks of a scene.
        on_task: Called after each.
    """
    arm = arm_of(config.trajectories.robot)
    costs = []
    for scene in scenes:
        for_things, for_tasks = rng_for(config.run.seed, scene.scene_id, "trajectories").spawn(2)
        cell = WorkCell(scene, arm, config.trajectories, for_things, services)
        tasks = [row for row in scene.task_rows if row["accepted"]][: config.trajectories.max_tasks]
        for task, rng in list(zip(tasks, for_tasks.spawn(len(tasks)), strict=True))[:most]:
            costs.append(_cost(cell, task, config, rng, ompl))
            if on_task is not None:
                on_task()
    return costs


def _cost(cell: WorkCell, task: Mapping[str, Any], config: Config, rng: np.random.Generator, ompl: bool) -> TaskCost:
    cost = TaskCost(str(task["scene_id"]), str(task["task_id"]), str(task["relation"]))
    clock = _Clock(cost.cpu_s)
    with clock.on(GRASPS):
        cell.grasps(str(task["x_id"]))
    with clock.on(WHOLE):
        found = search(cell, task, config.trajectories, rng)
    cost.cpu_s[WHOLE] += cost.cpu_s[GRASPS]
    cost.tried, cost.survives = found.tried, found.survives
    attempt = found.attempt
    cost.ended = found.reason if attempt is None else attempt.reason
    goal = goal_of(cell.files, task, config.trajectories.max_disturbed_m)
    cost.free = _is_free(cell, goal.x_id)
    others = [thing for name, thing in cell.things.items() if name not in (goal.x_id, goal.y_id)]
    with clock.on(PLACES):
        x, y = cell.things[goal.x_id], cell.things[goal.y_id]
        placements(Relation(goal.relation), x, y, others, cell.table, config.trajectories, rng)
    if attempt is not None and attempt.motion is not None:
        _parts(cell, goal, attempt, attempt.motion, config, rng, ompl, cost, clock)
    return cost


def _is_free(cell: WorkCell, object_id: str) -> bool:
    x = cell.things[object_id].body
    others = [thing.body for name, thing in cell.things.items() if name != object_id]
    return all(body.high[2] <= x.low[2] + BESIDE_M or outline_gap(x, body) >= FREE_M for body in others)


def _parts(
    cell: WorkCell,
    goal: Goal,
    attempt: Attempt,
    motion: Motion,
    config: Config,
    rng: np.random.Generator,
    ompl: bool,
    cost: TaskCost,
    clock: "_Clock",
) -> None:
    """What led to a motion, done again and measured: the pair that it takes and lets go with is known now."""
    settings, world, home = config.trajectories, cell.world(attempt.base), cell.station.arm.home
    tcp_grasp, tcp_place = (world.tcp(motion.positions[_last(motion, phase)]) for phase in (Phase.GRASP, Phase.PLACE))
    width = _width(cell, goal.x_id, tcp_grasp)
    planner = _Watched()
    with clock.on(PLANNING):
        plan(world, home, tcp_grasp, tcp_place, goal.x_id, width, settings, rng, planner)
    with clock.on(RECHECK):
        recheck(world, motion, goal.x_id, width, settings)
    with clock.on(ROLLOUT):
        execute_and_check(cell.station, attempt.base, motion, goal)
    if attempt.success:
        with clock.on(CHANGED):
            robust_to(cell.station, attempt.base, motion, goal)
    with clock.on(IK, 2):
        for tcp in (tcp_grasp, tcp_place):
            solutions(world.chain, world.in_base(tcp), home, 8)
    _paths(world, planner.asked, config, rng, ompl, cost, clock)


def _paths(
    world: World,
    asked: Sequence[tuple[JointVector, JointVector, Space]],
    config: Config,
    rng: np.random.Generator,
    ompl: bool,
    cost: TaskCost,
    clock: "_Clock",
) -> None:
    """The problems of the planner, solved by each; what ours gives is timed."""
    planners: dict[str, Planner] = {PATH: RrtConnect(), **({OMPL: OmplConnect()} if ompl else {})}
    settings, arm = config.trajectories, world.station.arm
    for start, goal, space in asked:
        found: dict[str, JointPath | None] = {}
        for name, planner in planners.items():
            with clock.on(name, len(asked)):
                found[name] = planner.path(start, goal, space, rng)
        lengths = {name: path_length(path) for name, path in found.items() if path is not None}
        cost.problems.append(Problem({name: path is not None for name, path in found.items()}, lengths))
        ours = found[PATH]
        if ours is not None:
            world.dynamics.carry(world.station, space.carried)
            with clock.on(TIMING, len(asked)):
                curve = blended(ours, BLEND_RAD, touch_at_start=False, touch_at_end=False)
                retimed(curve, arm, world.dynamics, settings.speed, settings.step_s)


class _Watched(RrtConnect):
    """Our planner, which notes what it is asked."""

    def __init__(self) -> None:
        self.asked: list[tuple[JointVector, JointVector, Space]] = []

    def path(self, start: JointVector, goal: JointVector, space: Space, rng: np.random.Generator) -> JointPath | None:
        """As `Planner.path`."""
        self.asked.append((start, goal, space))
        return super().path(start, goal, space, rng)


class _Clock:
    """CPU time of this process by what it was spent on."""

    def __init__(self, spent: dict[str, float]) -> None:
        self._spent = spent

    @contextmanager
    def on(self, what: str, of: int = 1) -> Iterator[None]:
        """Books the time of a block; where there are `of` such blocks or it holds as many problems, their mean."""
        started = time.process_time()
        yield
        self._spent[what] = self._spent.get(what, 0.0) + (time.process_time() - started) / of


def _width(cell: WorkCell, object_id: str, tcp: Pose) -> float:
    """Distance between the contacts of the grasp that was taken [m]."""
    grasps = cell.grasps(object_id)
    nearest = int(np.argmin(np.linalg.norm(grasps.positions - tcp.position, axis=1)))
    return float(grasps.widths[nearest])


def _last(motion: Motion, phase: Phase) -> int:
    return int(np.flatnonzero(motion.phases == list(Phase).index(phase))[-1])


@dataclass(frozen=True, slots=True)
class Rates:
    """What became of tasks.

    Attributes:
        tasks: How many by relation, then of all.
        succeeded: How many of them.
        free: As `tasks`, of objects with nothing beside them.
        free_succeeded: How many of those.
        reasons: Of those that did not, most frequent first.
        survived: Share of the successes that succeed under each change too.
    """

    tasks: Mapping[str, int]
    succeeded: Mapping[str, int]
    free: Mapping[str, int]
    free_succeeded: Mapping[str, int]
    reasons: Mapping[str, int]
    survived: Mapping[str, float]


ALL = "all"


def rates(costs: Sequence[TaskCost]) -> Rates:
    """Counts over all tasks."""
    done = [cost for cost in costs if not cost.ended]
    share = {name: sum(name in cost.survives for cost in done) / len(done) for name in CHANGES} if done else {}
    reasons = dict(Counter(cost.ended for cost in costs if cost.ended).most_common())
    order = [*sorted({cost.relation for cost in costs}), ALL]

    def counted(some: Iterable[TaskCost]) -> dict[str, int]:
        found = Counter(name for cost in some for name in (cost.relation, ALL))
        return {name: found[name] for name in order}

    free = [cost for cost in costs if cost.free]
    return Rates(counted(costs), counted(done), counted(free), counted(c for c in free if not c.ended), reasons, share)


def quantiles(costs: Sequence[TaskCost]) -> dict[str, tuple[int, float, float]]:
    """Of each part: how many tasks came to it, median and 95th percentile of its CPU time [s]."""
    seconds: defaultdict[str, list[float]] = defaultdict(list)
    for cost in costs:
        for name, spent in cost.cpu_s.items():
            seconds[name].append(spent)
    order = (WHOLE, GRASPS, PLACES, PLANNING, IK, PATH, OMPL, TIMING, RECHECK, ROLLOUT, CHANGED)
    return {
        name: (len(seconds[name]), float(np.median(seconds[name])), float(np.percentile(seconds[name], 95)))
        for name in order
        if seconds[name]
    }


def path_lengths(costs: Sequence[TaskCost]) -> dict[str, tuple[int, int, float]]:
    """Of each planner: problems, how many it solved, and the median length of its paths where all solved it [rad]."""
    problems = [problem for cost in costs for problem in cost.problems]
    solved = [problem for problem in problems if all(problem.found.values())]
    names = list(problems[0].found) if problems else []
    return {
        name: (
            len(problems),
            sum(problem.found[name] for problem in problems),
            float(np.median([problem.length_rad[name] for problem in solved])) if solved else float("nan"),
        )
        for name in names
    }
