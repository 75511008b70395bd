"""Scenes of training: what stands where, seen by which cameras; from a seed alone."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.training.picture.builder import MAX_THINGS, SceneBuilder, SceneTables, join_scenes
from tableverse_factory.evaluation.training.picture.columns import Material, Scene, View
from tableverse_factory.evaluation.training.picture.materials import (
    PLAIN,
    TextureBook,
    make_surface_material,
    make_thing_material,
)
from tableverse_factory.evaluation.training.picture.patterns import pick_skin_color
from tableverse_factory.evaluation.training.picture.surroundings import (
    add_arms,
    add_far_clutter,
    add_furniture,
    add_light,
    add_room,
    add_table,
)
from tableverse_factory.evaluation.training.picture.tables import MeshTables
from tableverse_factory.evaluation.training.picture.things import Part, ThingMaker, arrange_things, make_turn
from tableverse_factory.geometry.math.transforms import rotation_matrix

FOCAL_RANGE = (0.67, 1.5)  # in widths of the picture
RIG_SHARE = 0.4  # of views as the cameras of robots and desks see: their focal lengths, heights and distances
RIG_FOCAL, RIG_ELEVATION, RIG_DISTANCE_M = (0.78, 1.02), (24, 62), (0.45, 1.35)
STEEP_SHARE, STEEP_ELEVATION = 0.08, (62, 90)  # of views, rigs' among them, that look down
ROLL, MUCH_ROLL, MUCH_ROLL_SHARE = 0.05, 0.15, 0.4  # deviations [rad]: a net that saw little roll answers with none
COUNTS = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16)
COUNT_SHARES = (0.08, 0.1, 0.11, 0.12, 0.12, 0.12, 0.12, 0.1, 0.08, 0.05)
SETTLED_SHARE, EMPTY_SHARE = 0.4, 0.03
NO_TABLE_SHARE = 0.09
CLOSE_SHARE = 0.1
HELD_OUT = 10
TRIES = 12  # cameras tried per view


@dataclass(frozen=True, slots=True, eq=False)
class SceneMaker:
    """Makes scenes from meshes and textures; `arrangements` are the settled ones it may use, `pool` the meshes."""

    tables: MeshTables
    book: TextureBook
    arrangements: Sequence[int]
    pool: Sequence[int]
    size: tuple[int, int]  # width and height of a view [px]

    @classmethod
    def hold_out(
        cls, tables: MeshTables, book: TextureBook, size: tuple[int, int]
    ) -> tuple["SceneMaker", "SceneMaker"]:
        """Split arrangements and their meshes into those of training and every tenth, for validation."""
        makers = []
        for held in (False, True):
            own = [index for index in range(len(tables.settled)) if (index % HELD_OUT == 0) == held]
            pool = [int(row[0]) for index in own for row in tables.settled[index]]
            makers.append(cls(tables.drop_triangles(), book, own, pool, size))
        return makers[0], makers[1]

    def make_pack(self, seed: int, index: int, scenes: int, views: int) -> SceneTables:
        """Make scenes with up to `views` cameras each, joined; depends on the arguments alone."""
        rng = make_rng(seed, f"pack_{index}", "picture")
        return join_scenes([self._make_scene(rng, views) for _ in range(scenes)])

    def _make_scene(self, rng: np.random.Generator, views: int) -> SceneTables:
        builder = SceneBuilder(self.tables, self.book)
        if rng.random() < NO_TABLE_SHARE:
            _furnish_without_table(rng, builder)
            builder.views += _aim_anywhere(rng, builder, self.size, views)
            return builder.build()
        maker = ThingMaker(self.tables, self.pool)
        self._add_things(rng, builder, maker)
        azimuth = rng.integers(4) * np.pi / 2 + rng.normal(0, 0.25)
        extras = rng.random(2)
        far = rng.uniform(0.4, 1.1) if extras[0] < 0.22 else 0.0
        add_table(rng, builder, azimuth, far)
        add_room(rng, builder)
        add_furniture(rng, builder)
        if far:
            add_far_clutter(rng, builder, maker, azimuth, far)
        if extras[1] < 0.1:
            add_arms(rng, builder)
        low, high = builder.measure_things()
        add_light(rng, builder, (low + high) / 2)
        spread = 0.5 if far else np.pi
        builder.views += [
            view
            for _ in range(views)
            if (view := _aim_at_things(rng, builder, self.size, azimuth + rng.uniform(-spread, spread))) is not None
        ]
        return builder.build()

    def _add_things(self, rng: np.random.Generator, builder: SceneBuilder, maker: ThingMaker) -> None:
        kind = rng.random()
        if kind < EMPTY_SHARE:
            return
        if kind < EMPTY_SHARE + SETTLED_SHARE and self.arrangements:
            rows = self.tables.settled[self.arrangements[int(rng.integers(len(self.arrangements)))]]
            scale = rng.uniform(0.88, 1.18)
            groups = [
                [Part(int(row[0]), rotation_matrix(row[4:8]) * scale, row[1:4] * scale, printed=0.4)] for row in rows
            ]
        else:
            count = int(rng.choice(COUNTS, p=COUNT_SHARES))
            groups = [thing.list_parts() for thing in arrange_things(rng, maker, count)]
        for index, parts in enumerate(groups[:MAX_THINGS]):
            builder.add_parts(rng, parts, index + 1)


def _furnish_without_table(rng: np.random.Generator, builder: SceneBuilder) -> None:
    """Make a room, a landscape, or a face-like blob before a wall, where no table is."""
    row = builder.row
    row[Scene.HALF_SIZE] = 0.01
    row[Scene.TABLE_MATERIAL] = builder.add_material(make_surface_material(rng, builder.book))
    row[Scene.FLOOR_Z] = -rng.uniform(0.7, 1.6)
    add_room(rng, builder)
    kind = rng.random()
    if kind < 0.35:  # outdoors
        row[Scene.ROOM_LOW][:2], row[Scene.ROOM_HIGH][:2] = -60.0, 60.0
        row[Scene.CEILING_Z], row[Scene.HAS_SKY] = 30.0, 1.0
        row[Scene.HORIZON] = np.clip(rng.uniform(0.02, 1.0) * rng.uniform(0.7, 1.2, 3), 0, 1.5)
        dimmed = row[Scene.HORIZON] * rng.uniform(0.2, 1.0, 3)
        row[Scene.ZENITH] = np.clip(dimmed + rng.uniform(0, 0.3) * np.array([0, 0.2, 0.6]), 0, 2)
        for slot in (Scene.FLOOR, Scene.WALL):
            material = make_surface_material(rng, builder.book)
            material[Material.SCALE] *= rng.uniform(0.05, 0.5)
            row[slot] = builder.add_material(material)
    if kind < 0.7:
        add_furniture(rng, builder, 14)
    else:
        _add_portrait(rng, builder)
    add_light(rng, builder, np.array([0.0, 0.0, float(row[Scene.FLOOR_Z]) / 2]))


def _add_portrait(rng: np.random.Generator, builder: SceneBuilder) -> None:
    """Add a few large blobs at eye level: head, shoulders, hair; skin, fur or cloth."""
    shapes = builder.tables.find("blob", "cushion", "limb", "lathe", "box")
    skin = pick_skin_color(rng)
    for index in range(int(rng.integers(2, 14))):
        mesh = shapes[int(rng.integers(len(shapes)))]
        low, high = builder.tables.low[mesh], builder.tables.high[mesh]
        material = make_thing_material(rng, builder.book, low, high)
        if rng.random() < 0.5:
            material[Material.COLOR], material[Material.BLEND], material[Material.BAND_START] = skin, PLAIN, 2.0
        size = rng.uniform(0.1, 0.5, 3) if index < 3 else rng.uniform(0.02, 0.15, 3)
        place = rng.normal(0, 0.18, 3) + np.array([0, 0, 0.1])
        turn = make_turn(0, rng.uniform(0, 6.3)) @ make_turn(1, rng.uniform(0, 6.3))
        builder.add_mesh(mesh, turn @ np.diag(size), place, builder.add_material(material))


def _aim_at_things(
    rng: np.random.Generator, builder: SceneBuilder, size: tuple[int, int], azimuth: float
) -> np.ndarray | None:
    """Aim a camera at all things, or closely at one; None if no try stays within the room."""
    low, high = builder.measure_things()
    for _ in range(TRIES):
        rig = rng.random() < RIG_SHARE
        focal = size[0] * float(np.exp(rng.uniform(*np.log(RIG_FOCAL if rig else FOCAL_RANGE))))
        angles = RIG_ELEVATION if rig else (20, 72) if rng.random() < 0.75 else (10, 89)
        elevation = np.radians(rng.uniform(*(STEEP_ELEVATION if rng.random() < STEEP_SHARE else angles)))
        close = not rig and rng.random() < CLOSE_SHARE and builder.boxes
        box = builder.boxes[int(rng.integers(len(builder.boxes)))] if close else np.stack([low, high])
        middle, radius = box.mean(axis=0), float(np.linalg.norm(box[1] - box[0])) / 2
        if close:
            distance = max(0.14, focal * radius / (size[1] * rng.uniform(0.3, 0.75)))
        else:
            distance = rng.uniform(*RIG_DISTANCE_M) if rig else rng.uniform(0.4, 1.6)
            if not rng.uniform(0.08, 0.16) < focal * radius / distance / size[0] < 0.68:
                continue
        target = middle + np.array([*rng.normal(0, 0.25 * radius + 0.02, 2), 0.0])
        target[2] *= 0.6
        toward = [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)]
        eye = target + distance * np.array(toward)
        inside = (eye > builder.row[Scene.ROOM_LOW] + 0.06).all() and (eye < builder.row[Scene.ROOM_HIGH] - 0.06).all()
        if 0.08 < eye[2] < 1.6 and inside:
            return _make_view(rng, eye, target, focal, size)
    return None


def _aim_anywhere(
    rng: np.random.Generator, builder: SceneBuilder, size: tuple[int, int], count: int
) -> list[np.ndarray]:
    """Aim cameras from about eye level to any side."""
    views = []
    low, high = builder.row[Scene.ROOM_LOW] + 0.3, builder.row[Scene.ROOM_HIGH] - 0.3
    for _ in range(count):
        focal = size[0] * float(np.exp(rng.uniform(*np.log(FOCAL_RANGE))))
        angle, away = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 2.5)
        eye = np.array([away * np.cos(angle), away * np.sin(angle), rng.uniform(-0.3, 0.7)])
        eye = np.clip(eye, low, np.maximum(high, low))
        views.append(_make_view(rng, eye, rng.normal(0, 0.3, 3), focal, size))
    return views


def _make_view(
    rng: np.random.Generator, eye: np.ndarray, target: np.ndarray, focal: float, size: tuple[int, int]
) -> np.ndarray:
    """Make the row of a camera that looks at a target, rolled a little, its centre a little off."""
    forward = target - eye
    forward /= max(float(np.linalg.norm(forward)), 1e-6)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.9999 else [1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    roll = rng.normal(0, MUCH_ROLL if rng.random() < MUCH_ROLL_SHARE else ROLL)
    c, s = np.cos(roll), np.sin(roll)
    view = np.zeros(View.WIDTH, dtype=np.float32)
    view[View.EYE] = eye
    view[View.AXES] = np.stack([c * right + s * down, c * down - s * right, forward], axis=1).ravel()
    view[View.FOCAL] = focal
    view[View.CENTER] = (np.array(size) - 1) / 2 + rng.normal(0, 0.012 * size[0], 2)
    view[View.SEED] = rng.integers(1 << 20)
    return view
