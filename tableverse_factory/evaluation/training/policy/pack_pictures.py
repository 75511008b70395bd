"""Packing of pictures: the first of each demonstration, more of its scene, and synthetic tables of no dataset."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Self

import numpy as np

from schemas.geometry import Pose
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.dataset.dataset import Dataset, Scene, open_dataset
from tableverse_factory.delivery.episodes.actors import ArmMeshes, build_render_scene
from tableverse_factory.delivery.episodes.observation import list_objects, read_object_poses
from tableverse_factory.delivery.episodes.pictures import join_poses
from tableverse_factory.delivery.episodes.selection import Episode, load_recording
from tableverse_factory.delivery.learning.camera import retexture_table
from tableverse_factory.delivery.learning.variation import draw_lighting, draw_table_seed
from tableverse_factory.evaluation.benchmark.splits import select_known_phrases
from tableverse_factory.evaluation.training.policy.pack import Row, list_motions
from tableverse_factory.evaluation.training.policy.packed_pictures import PackedPictures
from tableverse_factory.evaluation.training.policy.synthetic_views import TABLES, take_synthetic_view
from tableverse_factory.evaluation.training.policy.views import PosedScene, View, join_views, load_figure, take_view
from tableverse_factory.geometry.math.transforms import multiply_quaternions, quaternion_about_z

VIEWS = 3  # more of each scene
SHIFT_M, TURN_RAD = 0.08, 0.35  # most that the arm's base is moved along each axis, and turned, for more views
HELD_OUT_EVERY = 20  # of the tables


@dataclass(frozen=True, slots=True)
class _Work:
    path: str
    robot: str
    scene_id: str
    rows: tuple[Row, ...]
    phrases: Mapping[str, tuple[str, ...]]
    views: int


def pack_pictures(
    datasets: Sequence[Dataset],
    splits: Sequence[str] = ("train", "validation"),
    robot: str = "panda",
    on_scene: Callable[[int, int], object] = lambda _done, _total: None,
    jobs: int = 1,
    views: int = VIEWS,
    tables: int = TABLES,
) -> PackedPictures:
    """Take and pack the pictures that `pack_demonstrations` with the same arguments has the motions of.

    Each scene is also seen `views` times from about where its motions' arms stand, in another light and half of the
    times on another table; and so many synthetic `tables` are drawn. Nouns that the benchmark holds out are not told.
    """
    motions = list_motions(datasets, splits, robot)
    phrases: dict[str, dict[str, tuple[str, ...]]] = {}
    for dataset in datasets:  # a scene is in one of them alone
        phrases |= _list_phrases(dataset)
    work = [
        _Work(str(own.dataset.path), robot, own.scene_id, own.rows, phrases.get(own.scene_id, {}), views)
        for own in motions
    ]
    first: list[tuple[View, bool]] = []
    more: list[tuple[View, bool]] = []
    total = len(motions) + tables
    results = parallel_map(_take_views, work, jobs, "takes pictures")
    for done, (own, (taken, others)) in enumerate(zip(motions, results, strict=True), 1):
        first += [(view, own.split == "validation") for view in taken]
        more += [(view, own.split == "validation") for view in others]
        on_scene(done, total)
    draw = partial(take_synthetic_view, robot=robot)
    for number, view in enumerate(parallel_map(draw, range(tables), jobs, "draws tables")):
        more.append((view, number % HELD_OUT_EVERY == 0))
        on_scene(len(motions) + number + 1, total)
    return join_views(robot, [*first, *more])


def _list_phrases(dataset: Dataset) -> dict[str, dict[str, tuple[str, ...]]]:
    """List the phrases that tell each object from all others of its scene, but for held-out nouns."""
    columns = ["scene_id", "object_id", "distinguishing_phrases"]
    found: dict[str, dict[str, tuple[str, ...]]] = {}
    for row in dataset.objects.to_table(columns=columns).to_pylist():
        if known := select_known_phrases(row["distinguishing_phrases"] or ()):
            found.setdefault(row["scene_id"], {})[row["object_id"]] = known
    return found


def _take_views(work: _Work) -> tuple[list[View], list[View]]:
    """Take the first pictures of a scene's motions, and more of the scene as it stands then."""
    scene, figure = open_dataset(work.path).scene(work.scene_id), load_figure(work.robot)
    rng = make_rng(0, work.scene_id, "pictures of policies")
    starts = [_Start.read(scene, row) for row in work.rows]
    first = [take_view(start.pose(figure, start.base, work.phrases), work.robot) for start in starts]
    more = [starts[int(rng.integers(len(starts)))] for _ in range(work.views)]
    return first, [take_view(_change_looks(start, figure, work.phrases, rng), work.robot) for start in more]


@dataclass(frozen=True, slots=True, eq=False)
class _Start:
    """Scene before a motion: the poses of its objects by id, and positions of the arm's joints and fingers."""

    scene: Scene
    objects: dict[str, np.ndarray]
    positions: np.ndarray
    base: Pose

    @classmethod
    def read(cls, scene: Scene, row: Row) -> Self:
        episode, model = Episode(row, scene, load_recording(scene, row)), scene.model()
        objects = dict(zip(list_objects(model, episode), read_object_poses(model, episode)[0], strict=True))
        return cls(scene, objects, episode.recording.qpos[0].astype(np.float64), episode.recording.base)

    def pose(self, figure: ArmMeshes, base: Pose, phrases: Mapping[str, tuple[str, ...]]) -> PosedScene:
        cast = build_render_scene(self.scene, set(self.objects), figure, base)
        poses = join_poses(self.objects, cast, figure.poses(self.positions, base))
        return PosedScene(cast, tuple(self.objects), poses, base, phrases)


def _change_looks(
    start: _Start, figure: ArmMeshes, phrases: Mapping[str, tuple[str, ...]], rng: np.random.Generator
) -> PosedScene:
    """Move the arm's base, light the scene anew, and lay half of the times another table; names stay true."""
    shift = np.array([*rng.uniform(-SHIFT_M, SHIFT_M, 2), 0.0])
    turn = quaternion_about_z(float(rng.uniform(-TURN_RAD, TURN_RAD)))
    base = Pose(start.base.position + shift, multiply_quaternions(turn, start.base.quaternion_wxyz))
    posed = replace(start.pose(figure, base, phrases), lighting=draw_lighting(rng))
    if rng.random() < 0.5:
        posed = replace(posed, cast=retexture_table(posed.cast, start.scene, draw_table_seed(rng)))
    return posed
