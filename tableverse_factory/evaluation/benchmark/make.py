"""Benchmark of a dataset: which tasks become episodes, how hard each is, and what is changed along each axis."""

import hashlib
import math
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

from schemas.curation import Relation
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.dataset.dataset import Dataset, Scene, open_dataset
from tableverse_factory.delivery.episodes.instructions import read_instruction
from tableverse_factory.delivery.learning.environment import FPS
from tableverse_factory.evaluation.benchmark.benchmark import (
    AXES,
    MAX_LIMIT_STEPS,
    SPLITS,
    Axis,
    Benchmark,
    DifficultyRecord,
    Episode,
    Perturbation,
    Split,
    StartRecord,
    TaskRecord,
    digest_scene,
)
from tableverse_factory.evaluation.benchmark.clutter import draw_clutter
from tableverse_factory.evaluation.benchmark.difficulty import measure_difficulty
from tableverse_factory.evaluation.benchmark.splits import find_noun, is_held_out, list_split_tasks
from tableverse_factory.geometry.math.transforms import transform_points
from tableverse_factory.physics.mjcf.scene_objects import load_mesh, load_scene_objects
from tableverse_factory.robotics.execution.poses import pose_from_row
from tableverse_factory.robotics.robots.registry import load_arm

Task = tuple[str, str]  # ids of scene and task

POSITION_M, YAW_RAD = 0.03, 0.3  # of the axis `start`
FRICTION = 2.0  # factor of the axis `friction`, and its inverse
CLUTTER = 2  # objects that are added along the axis `clutter`
MAX_DISTURBED_M = 0.02
TIME_FACTOR = 2.0  # time for a policy over that of the recorded motion
_PERTURBATIONS: Mapping[Axis, Perturbation] = {
    "none": Perturbation(),
    "start": Perturbation(axis="start"),
    "texture": Perturbation(axis="texture", table=True),
    "light": Perturbation(axis="light", lights=True),
    "camera": Perturbation(axis="camera", cameras=True),
    "friction": Perturbation(axis="friction", friction=FRICTION),
}


@dataclass(frozen=True, slots=True)
class BenchmarkSettings:
    """What is made: unperturbed episodes per split, and those of the test split that are repeated along each axis."""

    episodes: int = 150
    perturbed: int = 60
    seed: int = 0
    robot: str = "panda"


@dataclass(frozen=True, slots=True)
class _MeasuredTask:
    """What a recorded motion tells of its task."""

    task: TaskRecord
    base: tuple[float, ...]
    limit_steps: int
    difficulty: DifficultyRecord


def make_benchmark(dataset: Dataset, settings: BenchmarkSettings, jobs: int = 1) -> Benchmark:
    """Make the benchmark of a dataset; the same dataset and settings give the same one, with any number of `jobs`.

    Episodes are of tasks that a recorded motion solves, so that each is known to have a solution. Perturbed episodes
    repeat episodes of the test split with the same seed; those for which no clutter finds room are left out.

    Raises:
        InputError: `no_trajectories` if no motion solves any task.
    """
    if settings.episodes < 1 or settings.perturbed < 0:
        raise ConfigError(f"{settings.episodes} episodes, {settings.perturbed} perturbed: at least 1 and 0")
    chosen = _choose_tasks(list_split_tasks(dataset, settings.robot), settings)
    by_scene: dict[str, list[str]] = defaultdict(list)
    for scene_id, task_id in chosen:
        by_scene[scene_id].append(task_id)
    measure = partial(_measure_tasks, dataset.path, load_arm(settings.robot).name)
    found = parallel_map(measure, sorted(by_scene.items()), jobs, "measures tasks")
    measured = {
        (scene_id, task.task.task_id): task
        for (scene_id, _), tasks in zip(sorted(by_scene.items()), found, strict=True)
        for task in tasks
    }
    clean = _make_episodes(chosen, measured, settings.seed)
    repeated = [e for e in clean if e.split == "test"][: settings.perturbed]
    donors = sorted({episode.scene_id for episode in clean})
    clutter = parallel_map(partial(_clutter, dataset.path, settings.robot, donors), repeated, jobs, "places clutter")
    perturbed = [
        episode.model_copy(update={"episode_id": f"{episode.episode_id}_{change.axis}", "perturbation": change} | start)
        for episode, added in zip(repeated, clutter, strict=True)
        for change, start in _iterate_changes(episode, added)
    ]
    episodes = (*clean, *perturbed)
    return Benchmark(
        seed=settings.seed,
        robot=settings.robot,
        max_disturbed_m=MAX_DISTURBED_M,
        held_out_nouns=_list_held_out(dataset),
        scenes=_digest_scenes(dataset, episodes),
        episodes=episodes,
    )


def _choose_tasks(tasks: Mapping[Task, Split], settings: BenchmarkSettings) -> dict[Task, Split]:
    """Choose tasks of each split, in the order of their hashes, so that a larger choice holds a smaller one."""

    def rank(task: Task) -> str:
        return hashlib.sha256(f"{settings.seed} {task[0]} {task[1]}".encode()).hexdigest()

    ranked = sorted(tasks, key=rank)
    chosen = {split: [task for task in ranked if tasks[task] == split][: settings.episodes] for split in SPLITS}
    if not any(chosen.values()):
        raise InputError(
            "every solved task carries or refers to a held-out thing: give a larger dataset", "no_episodes"
        )
    return {task: split for split in SPLITS for task in chosen[split]}


@lru_cache(1)
def _open(path: str) -> Dataset:
    return open_dataset(path)


def _measure_tasks(path: str, robot: str, item: tuple[str, list[str]]) -> list[_MeasuredTask]:
    """Measure tasks of one scene by their recorded motions."""
    scene_id, task_ids = item
    scene = _open(path).scene(scene_id)
    objects = load_scene_objects(scene.files(), scene.object_rows())
    rows = {row["task_id"]: row for row in scene.task_rows()}
    found = []
    for trajectory in scene.trajectories():
        task_id = trajectory.row["task_id"]
        if task_id in task_ids and trajectory.row["robot"] == robot and trajectory.success:
            recording, row = trajectory.recording(), rows[task_id]
            relation, x_id, y_id = Relation(row["relation"]), row["x_id"], row["y_id"]
            placed = pose_from_row(recording.object_pose[-1])
            base = (*recording.base.position.tolist(), *recording.base.quaternion_wxyz.tolist())
            seconds = TIME_FACTOR * len(recording) * recording.step_s
            task = TaskRecord(
                task_id=task_id, x_id=x_id, y_id=y_id, relation=relation, instruction=read_instruction(row)
            )
            difficulty = measure_difficulty(objects, x_id, y_id, relation, placed)
            found.append(_MeasuredTask(task, base, min(math.ceil(seconds * FPS), MAX_LIMIT_STEPS), difficulty))
    return found


def _make_episodes(
    chosen: Mapping[Task, Split], measured: Mapping[Task, _MeasuredTask], seed: int
) -> tuple[Episode, ...]:
    count: dict[Split, int] = defaultdict(int)
    episodes = []
    for (scene_id, task_id), split in chosen.items():
        task = measured[scene_id, task_id]
        drawn = make_rng(seed, scene_id, f"episode {task_id}").integers(2**31)
        episodes.append(
            Episode(
                episode_id=f"{split}_{count[split]:04d}",
                scene_id=scene_id,
                split=split,
                seed=int(drawn),
                limit_steps=task.limit_steps,
                task=task.task,
                start=StartRecord(base=task.base),
                difficulty=task.difficulty,
            )
        )
        count[split] += 1
    return tuple(episodes)


def _iterate_changes(
    episode: Episode, clutter: Perturbation | None
) -> Iterator[tuple[Perturbation, dict[str, object]]]:
    """Iterate the perturbations of an episode, each with what it changes of the episode besides."""
    for axis in AXES:
        change = clutter if axis == "clutter" else _PERTURBATIONS[axis]
        if axis != "none" and change is not None:
            moved = episode.start.model_copy(update={"position_m": POSITION_M, "yaw_rad": YAW_RAD})
            yield change, {"start": moved} if axis == "start" else {}


def _clutter(path: str, robot: str, donor_ids: Sequence[str], episode: Episode) -> Perturbation | None:
    """Draw the clutter of an episode from other scenes; None where there is no room for all of it."""
    dataset, task = _open(path), episode.task
    scene = dataset.scene(episode.scene_id)
    rng = make_rng(episode.seed, episode.scene_id, f"clutter {task.task_id}")
    others = [name for name in donor_ids if name != episode.scene_id]
    names = [others[k] for k in rng.permutation(len(others))[: 4 * CLUTTER].tolist()]
    donors: list[Scene] = [dataset.scene(name) for name in names]
    placed = pose_from_row(scene.trajectory(task.task_id).recording().object_pose[-1])
    goal = transform_points(placed, load_mesh(scene.files(), task.x_id).vertices)
    added = draw_clutter(scene, donors, task.x_id, goal, load_arm(robot), episode.base, CLUTTER, rng)
    return Perturbation(axis="clutter", added=added) if len(added) == CLUTTER else None


def _list_held_out(dataset: Dataset) -> tuple[str, ...]:
    """List the nouns of a dataset that are held out."""
    rows = dataset.objects.to_table(columns=["label", "relabel_name"]).to_pylist()
    return tuple(sorted({noun for noun in map(find_noun, rows) if is_held_out(noun)}))


def _digest_scenes(dataset: Dataset, episodes: Sequence[Episode]) -> dict[str, str]:
    needed = sorted({scene for episode in episodes for scene in episode.scenes})
    return {scene_id: digest_scene(dataset.scene(scene_id).files()) for scene_id in needed}
