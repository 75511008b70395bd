"""Surroundings of the things: table, room, furniture, carpets, people's arms, clutter at the table's end, light."""

import numpy as np

from tableverse_factory.evaluation.training.picture.builder import SceneBuilder
from tableverse_factory.evaluation.training.picture.columns import Light, Material, Scene
from tableverse_factory.evaluation.training.picture.materials import (
    BOXED,
    TEXTURED,
    make_plain,
    make_surface_material,
    make_thing_material,
)
from tableverse_factory.evaluation.training.picture.patterns import pick_color, pick_skin_color
from tableverse_factory.evaluation.training.picture.tables import TABLE_TOP
from tableverse_factory.evaluation.training.picture.things import ThingMaker, make_turn

SLAB, DISC = 1.0, 2.0
LONG_SHARE, LONG_M = 0.3, (0.4, 1.6)  # of tables that go on far to one or both sides of the things, and by how much
SHEET_M = 0.0015  # thickest cloth or sheet of paper, part of the table


def add_table(rng: np.random.Generator, builder: SceneBuilder, azimuth: float, far_m: float) -> None:
    """Add a table under the things: slab, small round one or school desk, its legs, and often cloths or paper.

    `far_m` is how far it goes on behind the things, seen from a camera at `azimuth` [rad].
    """
    low, high = builder.measure_things()
    middle, half = (low + high)[:2] / 2, (high - low)[:2] / 2
    kind = rng.random()
    margin = rng.uniform(0.02, 0.25)
    size = half + margin + (rng.uniform(0, [0.8, 0.6]) if rng.random() < 0.65 else 0.0)
    if rng.random() < LONG_SHARE:
        size[int(rng.integers(2))] += rng.uniform(*LONG_M)
    slack = np.maximum(size - half - 0.02, 0)
    center = middle + rng.uniform(-0.95, 0.95, 2) * slack
    if far_m > 0.0:
        center = center - 0.5 * far_m * np.array([np.cos(azimuth), np.sin(azimuth)])
        size = size + 0.5 * far_m * np.abs([np.cos(azimuth), np.sin(azimuth)])
    row = builder.row
    row[Scene.TABLE_KIND], row[Scene.THICKNESS] = SLAB, rng.uniform(0.015, 0.07)
    if kind < 0.14 and far_m == 0.0:
        row[Scene.TABLE_KIND], center = DISC, middle
        size = np.full(2, np.hypot(*half) + 0.02 + (rng.uniform(0, 0.12) if kind < 0.08 else rng.uniform(0, 0.5)))
    floor = rng.uniform(0.35, 0.95) if rng.random() < 0.9 else rng.uniform(0.04, 0.3)
    row[Scene.TABLE_XY], row[Scene.HALF_SIZE], row[Scene.FLOOR_Z] = center, size, -floor
    row[Scene.TABLE_MATERIAL] = builder.add_material(make_surface_material(rng, builder.book, table=True))
    _add_legs(rng, builder, floor, is_desk=kind > 0.86)
    if rng.random() < 0.22:
        _add_sheets(rng, builder, middle, half)


def _add_legs(rng: np.random.Generator, builder: SceneBuilder, floor: float, is_desk: bool) -> None:
    row = builder.row
    (x, y), thick, (half_x, half_y) = row[Scene.TABLE_XY], float(row[Scene.THICKNESS]), row[Scene.HALF_SIZE]
    clear = max(floor - thick - 0.002, 0.01)
    material = builder.add_material(make_surface_material(rng, builder.book))
    if row[Scene.TABLE_KIND] == DISC:
        width = rng.uniform(0.03, 0.1)
        builder.add_box((width, width, clear), (x, y, -floor), material)
        return
    if is_desk and clear > 0.2:  # a shelf under the top, open to one side
        gap = rng.uniform(0.08, 0.18)
        builder.add_box((2 * half_x, 2 * half_y, 0.015), (x, y, -thick - gap), material)
        for side in (-1, 1):
            builder.add_box((0.015, 2 * half_y, gap), (x + side * (half_x - 0.008), y, -thick - gap), material)
    if rng.random() < 0.7 and clear > 0.2:
        width = rng.uniform(0.02, 0.08)
        for side in (-1, 1):
            for end in (-1, 1):
                place = (x + side * (half_x - width), y + end * (half_y - width), -floor)
                builder.add_box((width, width, clear), place, material)


def _add_sheets(rng: np.random.Generator, builder: SceneBuilder, middle: np.ndarray, half: np.ndarray) -> None:
    """Lay cloths, place mats, paper or marker boards: they are table."""
    box = builder.tables.find("box")[0]
    for _ in range(int(rng.integers(1, 4))):
        size = rng.uniform(0.1, 0.5, 2) if rng.random() < 0.6 else 2 * half * rng.uniform(0.6, 1.2, 2)
        size = np.minimum(size, 1.7 * builder.row[Scene.HALF_SIZE])
        place = middle + rng.uniform(-1, 1, 2) * half
        row = make_surface_material(rng, builder.book)
        if rng.random() < 0.6:
            row[Material.TEXTURE], row[Material.NEXT_FACE] = builder.book.pick_pattern(rng), 0.0
            row[Material.MAPPING], row[Material.BLEND] = BOXED, TEXTURED
            row[Material.SIZE], row[Material.LOW] = 1.0, (-0.5, -0.5, 0.0)
        map_ = make_turn(2, rng.uniform(0, 2 * np.pi)) @ np.diag([*size, rng.uniform(0.0003, SHEET_M)])
        builder.add_mesh(box, map_, np.array([*place, 0.0]), builder.add_material(row), TABLE_TOP)


def add_room(rng: np.random.Generator, builder: SceneBuilder) -> None:
    """Add floor, walls and ceiling about the table, sometimes with a wall close to it."""
    row = builder.row
    (x, y), (half_x, half_y) = row[Scene.TABLE_XY], row[Scene.HALF_SIZE]
    reach = rng.uniform(0.9, 3.5, 4)
    if rng.random() < 0.4:
        reach[int(rng.integers(4))] = rng.uniform(0.001, 0.25)
    row[Scene.ROOM_LOW][:2] = x - half_x - reach[0], y - half_y - reach[1]
    row[Scene.ROOM_HIGH] = x + half_x + reach[2], y + half_y + reach[3], rng.uniform(1.4, 2.7)
    for slot in (Scene.FLOOR, Scene.WALL, Scene.CEILING, Scene.OTHER_WALL):
        row[slot] = builder.add_material(make_surface_material(rng, builder.book))
    if rng.random() < 0.6:
        row[Scene.OTHER_WALL] = row[Scene.WALL]
    if rng.random() < 0.35:
        _add_carpet(rng, builder)


def _add_carpet(rng: np.random.Generator, builder: SceneBuilder) -> None:
    row = make_plain(pick_color(rng))
    row[Material.TEXTURES], row[Material.TEXTURE] = builder.book.count, builder.book.pick_pattern(rng)
    row[Material.MAPPING], row[Material.BLEND] = BOXED, TEXTURED
    row[Material.SIZE], row[Material.LOW] = 1.0, (-0.5, -0.5, 0.0)
    repeats = int(rng.integers(1, 4))
    row[Material.SIZE][:2] = 1.0 / repeats
    size = (*rng.uniform(1.0, 3.2, 2), 0.008)
    place = (*(builder.row[Scene.TABLE_XY] + rng.normal(0, 0.4, 2)), float(builder.row[Scene.FLOOR_Z]))
    builder.add_box(size, place, builder.add_material(row), rng.uniform(0, 2 * np.pi))


def add_furniture(rng: np.random.Generator, builder: SceneBuilder, most: int = 9) -> None:
    """Put boxes, shapes and chairs on the floor beside the table."""
    row = builder.row
    shapes = builder.tables.find("cushion", "blob", "lathe", "prism", "limb")
    for _ in range(int(rng.integers(0, most))):
        size = np.exp(rng.uniform(np.log(0.1), np.log(0.9), 3)) * [1, 1, 1.3]
        places = rng.uniform(row[Scene.ROOM_LOW][:2], row[Scene.ROOM_HIGH][:2], (8, 2))
        beside = (np.abs(places - row[Scene.TABLE_XY]) > row[Scene.HALF_SIZE] + size[:2] / 2 + 0.05).any(axis=1)
        if not beside.any():
            continue
        place = np.array([*places[beside.argmax()], row[Scene.FLOOR_Z]])
        kind, yaw = rng.random(), rng.uniform(0, 2 * np.pi)
        mesh = builder.tables.find("box")[0] if kind < 0.45 else shapes[int(rng.integers(len(shapes)))]
        low, high = builder.tables.low[mesh], builder.tables.high[mesh]
        material = builder.add_material(make_thing_material(rng, builder.book, low, high))
        if kind < 0.8:
            builder.add_mesh(mesh, make_turn(2, yaw) @ np.diag(size), place, material)
        else:
            _add_chair(builder, place, yaw, material)


def _add_chair(builder: SceneBuilder, place: np.ndarray, yaw: float, material: int) -> None:
    turn = make_turn(2, yaw)

    def put(size: tuple[float, float, float], offset: tuple[float, float, float]) -> None:
        builder.add_box(size, place + turn @ np.array(offset), material, yaw)

    put((0.42, 0.42, 0.05), (0, 0, 0.42))
    put((0.05, 0.42, 0.5), (0.2, 0, 0.45))
    for x in (-0.18, 0.18):
        for y in (-0.18, 0.18):
            put((0.03, 0.03, 0.42), (x, y, 0))


def add_far_clutter(
    rng: np.random.Generator, builder: SceneBuilder, maker: ThingMaker, azimuth: float, far_m: float
) -> None:
    """Put screens, piles and boxes at the table's far end: nobody asks for these, they are no things."""
    low, high = builder.measure_things()
    middle, toward = (low + high)[:2] / 2, np.array([np.cos(azimuth), np.sin(azimuth)])
    reach = float(np.abs(toward) @ (high - low)[:2] / 2)
    across = np.array([-toward[1], toward[0]])
    for _ in range(int(rng.integers(1, 8))):
        aside = rng.uniform(-0.9, 0.9) * float(np.abs(across) @ builder.row[Scene.HALF_SIZE])
        place = middle - toward * (reach + rng.uniform(0.28, max(0.3, far_m))) + across * aside
        thing, grow = maker.make(rng), rng.uniform(0.9, 2.4)
        turn = make_turn(2, rng.uniform(0, 2 * np.pi)) * grow
        for part in thing.parts:
            bounds = builder.tables.low[part.mesh], builder.tables.high[part.mesh]
            material = builder.add_material(make_thing_material(rng, builder.book, *bounds))
            offset = turn @ part.offset + [*place, 0.0]
            builder.add_mesh(part.mesh, turn @ part.map_, offset, material)


def add_arms(rng: np.random.Generator, builder: SceneBuilder) -> None:
    """Reach one or two arms over the table: sleeve, forearm, hand and fingers."""
    low, high = builder.measure_things()
    skin = make_plain(pick_skin_color(rng))
    hand = builder.add_material(skin)
    sleeve = builder.add_material(make_surface_material(rng, builder.book) if rng.random() < 0.7 else skin)
    for _ in range(int(rng.integers(1, 3))):
        angle = rng.uniform(0, 2 * np.pi)
        out = np.array([np.cos(angle), np.sin(angle)])
        palm = np.array([*rng.uniform(low[:2], high[:2]), rng.uniform(0.02, 0.3)])
        palm[:2] += out * rng.uniform(0.02, 0.2)
        wrist = palm + np.array([*(out * 0.07), rng.uniform(-0.01, 0.04)])
        elbow = wrist + np.array([*(out * rng.uniform(0.2, 0.3)), rng.uniform(0.0, 0.15)])
        shoulder = elbow + np.array([*(out * rng.uniform(0.15, 0.35)), rng.uniform(0.1, 0.4)])
        thick = rng.uniform(0.025, 0.04)
        builder.add_limb(palm, wrist, thick * 1.1, hand)
        builder.add_limb(wrist, elbow, thick * 1.2, hand if rng.random() < 0.4 else sleeve)
        builder.add_limb(elbow, shoulder, thick * 1.6, sleeve)
        for spread in np.linspace(-0.5, 0.5, int(rng.integers(3, 6))):
            turn = make_turn(2, spread)[:2, :2] @ -out
            tip = palm + np.array([*(turn * rng.uniform(0.04, 0.09)), rng.uniform(-0.04, 0.01)])
            builder.add_limb(palm + np.array([*(turn * 0.02), 0.0]), tip, rng.uniform(0.007, 0.011), hand)


def add_light(rng: np.random.Generator, builder: SceneBuilder, middle: np.ndarray) -> None:
    """Add one to four ceiling panels, windows and lamps, and an ambient term."""
    row = builder.row
    tone = 1 + rng.normal(0, 0.06, 3)
    row[Scene.AMBIENT] = rng.uniform(0.08, 0.55) * tone * (1 + rng.normal(0, 0.05, 3))
    count = int(rng.choice([1, 2, 3, 4], p=[0.35, 0.3, 0.2, 0.15]))
    for share in rng.dirichlet(np.ones(count)):
        place, u, v = _place_light(rng, row, middle)
        away = place - middle
        square = float(away @ away)
        facing = np.cross(u, v)
        area = float(np.linalg.norm(facing))
        up, front = away[2] / np.sqrt(square), abs(facing @ away) / (area * np.sqrt(square))
        gain = max(up, 0.15) * max(front, 0.15) * 4 * area / np.pi / max(square, 0.05)
        light = np.zeros(Light.WIDTH, dtype=np.float32)
        light[Light.CENTER], light[Light.HALF_U], light[Light.HALF_V] = place, u, v
        light[Light.RADIANCE] = np.clip(1 + rng.normal() * np.array([0.12, 0, -0.14]), 0.4, 1.6) * share / gain
        builder.lights.append(light)


def _place_light(
    rng: np.random.Generator, row: np.ndarray, middle: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Place a panel: its centre and its half edges [m]."""
    low, high = row[Scene.ROOM_LOW].astype(float), row[Scene.ROOM_HIGH].astype(float)
    kind = rng.random()
    u, v = np.zeros(3), np.zeros(3)
    if kind < 0.5:  # ceiling
        place = np.array([*(middle[:2] + rng.uniform(-1.5, 1.5, 2)), high[2] - 0.02])
        place[:2] = np.clip(place[:2], low[:2] + 0.05, high[:2] - 0.05)
        u[0], v[1] = rng.uniform(0.05, 0.8), rng.uniform(0.05, 0.5)
    elif kind < 0.8:  # window
        axis, far = int(rng.integers(2)), bool(rng.integers(2))
        place = np.array([*middle[:2], rng.uniform(0.3, 1.2)])
        place[axis] = high[axis] - 0.02 if far else low[axis] + 0.02
        place[1 - axis] += rng.uniform(-1, 1)
        u[1 - axis], v[2] = rng.uniform(0.2, 0.8), rng.uniform(0.2, 0.6)
    else:  # lamp
        away = rng.normal(0, 1, 3)
        away[2] = abs(away[2]) + 0.5
        place = np.clip(middle + away / np.linalg.norm(away) * rng.uniform(0.7, 1.5), low + 0.05, high - 0.05)
        u[0] = v[1] = rng.uniform(0.02, 0.12)
    return place, u, v
