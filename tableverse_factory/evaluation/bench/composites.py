"""Composites of synthetic models: how many things get into a container, and whether they are still there at rest."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from PIL import Image

from schemas.config import Config
from schemas.geometry import Picture, Pose, TriangleMesh
from schemas.objects import PlacedObject, PlacedObjects, Table
from schemas.outcome import Done
from schemas.scene import RectifiedLayout, SettledScene
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.seeding import rng_for
from tableverse_factory.evaluation.bench.panels import joined
from tableverse_factory.geometry.convex.decompose import decompose
from tableverse_factory.geometry.math.transforms import multiply_quaternions, quaternion_about_z
from tableverse_factory.geometry.mesh.meshes import bounds, placed_mesh
from tableverse_factory.geometry.relations.containers import holder_of
from tableverse_factory.models.services import Services
from tableverse_factory.physics.mjcf.drawables import scenery_of
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.render.views import FINE, front_eye, pictures
from tableverse_factory.sources.synthetic import food, packages, utensils, vessels
from tableverse_factory.sources.synthetic.model import Model
from tableverse_factory.stages.rectify.rectify import rectify
from tableverse_factory.stages.settle import settle

Maker = Callable[[np.random.Generator], Model]

VESSELS: dict[str, Maker] = {"bowl": vessels.bowl, "cup": vessels.cup, "mug": vessels.mug, "pan": vessels.pan}
CONTENTS: dict[str, tuple[Maker, float]] = {
    "marble": (food.orange, 0.25),
    "pear": (food.pear, 0.4),
    "block": (packages.wooden_block, 0.45),
    "lemon": (food.lemon, 0.6),
    "pen": (utensils.pen, 1.0),
}
"""What is put in, and its scale."""
COUNTS = (1, 4, 8, 12)
SHOWN = (("mug", "pear", 12), ("bowl", "lemon", 7), ("cup", "pen", 5))
_TABLE = Table(np.zeros(2), np.array([0.4, 0.4]), 0.0, (176, 148, 116), 0.0)
_SIZE, _AZIMUTH = (264, 208), float(np.deg2rad(20.0))


@dataclass(frozen=True, slots=True)
class CompositeScore:
    """One container and what was to be put into it.

    Attributes:
        container: Its kind.
        content: Kind of the things.
        asked: How many there should be.
        inside: How many were found room for.
        kept: How many are in the container when the scene has settled; 0 where it never came to rest.
        at_rest: Whether it did.
        assembly_s: CPU time of the rectify stage, almost all of it assembly, without decomposition [s].
        settling_s: CPU time of settling [s].
    """

    container: str
    content: str
    asked: int
    inside: int
    kept: int
    at_rest: bool
    assembly_s: float
    settling_s: float


def bench_composites(seed: int, config: Config, cache_dir: Path, on_done: Callable[[], None]) -> list[CompositeScore]:
    """Every vessel with every content, in numbers from 1 to 12; `on_done` is called after each."""
    scores = []
    for index, (container, content) in enumerate(product(VESSELS, CONTENTS)):
        asked = COUNTS[index % len(COUNTS)]
        scores.append(_score(container, content, asked, seed, config, Services(cache_dir)))
        on_done()
    return scores


def cases() -> int:
    """How many composites there are."""
    return len(VESSELS) * len(CONTENTS)


def write_picture(file: Path, seed: int, config: Config, cache_dir: Path) -> None:
    """Draws what was seen (above) and what stands on the table in the end (below) for `SHOWN`, as a PNG file."""
    columns = []
    for container, content, asked in SHOWN:
        item = composite(container, content, asked, seed)
        services = Services(cache_dir)
        scene = _settled(_rectified(item, seed, config, services), seed, config, services)
        if scene is None:
            raise BuildError(f"{item.scene_id} does not come to rest with seed {seed}: give another")
        seen = _drawn(item.objects, [o.pose for o in item.objects])
        columns.append(joined([seen, _drawn(scene.rectified.placed.objects, scene.poses)], 0))
    Image.fromarray(np.array(joined(columns, 1))).save(file, format="PNG", optimize=True)


def composite(container: str, content: str, asked: int, seed: int) -> PlacedObjects:
    """A vessel on the table, and one of the things seen over its floor, counted `asked` times."""
    scene_id = f"{asked} {content} in {container}"
    rng = rng_for(seed, scene_id, "bench")
    vessel, (make, scale) = VESSELS[container](rng), CONTENTS[content]
    thing = make(rng)
    low, high = bounds(thing.mesh)
    # What is long stands, as far as it can, the way pens do.
    stands = float(high[0] - low[0]) * scale > 0.12
    heading = quaternion_about_z(float(rng.uniform(0.0, 2 * np.pi)))
    upright = np.array([np.cos(0.7), 0.0, -np.sin(0.7), 0.0])
    turn = multiply_quaternions(heading, upright) if stands else heading
    mesh = placed_mesh(thing.mesh, Pose(np.zeros(3), turn), scale)
    middle = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    floor = vessel.cavity.floor if vessel.cavity is not None else 0.0
    at = np.array([-middle[0], -middle[1], floor + 0.002 - float(mesh.vertices[:, 2].min())])
    return PlacedObjects(
        scene_id,
        _TABLE,
        (
            PlacedObject("vessel", container, 1.0, _painted(vessel), 1.0, Pose(np.zeros(3), quaternion_about_z(0.4))),
            PlacedObject("thing", content, 1.0, _painted(thing), scale, Pose(at, turn), "vessel", asked),
        ),
    )


def _score(container: str, content: str, asked: int, seed: int, config: Config, services: Services) -> CompositeScore:
    item = composite(container, content, asked, seed)
    for placed in item.objects:
        decompose(placed.mesh, config.rectify, services.cache_dir)  # into the cache: its time is not counted
    start = time.process_time()
    layout = _rectified(item, seed, config, services)
    between = time.process_time()
    scene = _settled(layout, seed, config, services)
    settling_s = time.process_time() - between
    inside = len(layout.placed.objects) - 1
    kept = 0 if scene is None else _held(scene)
    return CompositeScore(container, content, asked, inside, kept, scene is not None, between - start, settling_s)


def _held(scene: SettledScene) -> int:
    """How many things are in the vessel, which is the first object."""
    objects = scene.rectified.placed.objects
    vessel, *things = (placed_mesh(o.mesh, pose, o.scale) for o, pose in zip(objects, scene.poses, strict=True))
    holder = holder_of(vessel)
    return sum(holder.holds(mesh) for mesh in things)


def _rectified(item: PlacedObjects, seed: int, config: Config, services: Services) -> RectifiedLayout:
    outcome = rectify(item, config, rng_for(seed, item.scene_id, "rectify"), services)
    if not isinstance(outcome, Done):
        raise BuildError(f"{item.scene_id}: {outcome}")
    return outcome.value


def _settled(layout: RectifiedLayout, seed: int, config: Config, services: Services) -> SettledScene | None:
    """The scene at rest, None where it never is."""
    outcome = settle(layout, config, rng_for(seed, layout.scene_id, "settle"), services)
    return outcome.value if isinstance(outcome, Done) else None


def _painted(model: Model) -> TriangleMesh:
    colors = np.clip(np.rint(model.texture(model.mesh.vertices)), 0, 255).astype(np.uint8)
    return replace(model.mesh, vertex_colors=colors)


def _drawn(objects: Sequence[PlacedObject], poses: Sequence[Pose]) -> Picture:
    meshes = [placed_mesh(o.mesh, pose, o.scale) for o, pose in zip(objects, poses, strict=True)]
    slab = Slab(_TABLE.center_xy, _TABLE.half_size_xy, _TABLE.yaw, _TABLE.color)
    scenery = scenery_of([o.object_id for o in objects], meshes, slab)
    width, height = _SIZE
    return pictures(scenery, (front_eye(scenery, width, height, _AZIMUTH),), FINE)[0].color
