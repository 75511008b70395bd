"""The paper's ablation as a picture: what each method makes of one layout, and what half a second makes of that."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from schemas.config import Config
from schemas.geometry import Picture, TriangleMesh
from tableverse_factory.evaluation.bench.layouts import read_case
from tableverse_factory.evaluation.bench.panels import joined
from tableverse_factory.evaluation.bench.rectifiers import METHODS
from tableverse_factory.evaluation.bench.release import ReleasedScene, after
from tableverse_factory.geometry.mesh.meshes import placed_mesh
from tableverse_factory.physics.mjcf.drawables import Rgb, Scenery, scenery_of
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.render.views import Eye, Quality, front_eye, pictures

LET_GO_S = 0.5
"""How long the lower row was simulated, freely [s]."""
WIDTH, HEIGHT = 400, 276
QUALITY = Quality(samples=2, sky_rays=6)
PALETTE: tuple[Rgb, ...] = (
    (201, 82, 66),
    (66, 119, 171),
    (222, 165, 62),
    (92, 148, 96),
    (138, 96, 155),
    (84, 168, 170),
    (205, 116, 150),
    (140, 110, 84),
    (226, 214, 188),
    (98, 104, 122),
)
"""sRGB of objects whose mesh has no colours of its own, in turn: no two next to one another are hard to tell apart."""
_AZIMUTH = float(np.deg2rad(28.0))
_TABLE_MARGIN_M = 0.25
_CAPTION = 24


def write_ablation(file: Path, layout: Path, methods: Sequence[str], config: Config, cache_dir: Path) -> None:
    """Draws what methods make of one layout, as a PNG file.

    Args:
        file: Where to; its folder is there.
        layout: A layout file.
        methods: Keys of `METHODS`.
        config: Of the run.
        cache_dir: Where convex pieces are kept.
    """
    case = read_case(layout, None, config, cache_dir)
    scenes = {name: METHODS[name](case, config).scene for name in methods}
    Image.fromarray(np.array(ablation(scenes, config.settle.timestep_s))).save(file, format="PNG", optimize=True)


def ablation(scenes: Mapping[str, ReleasedScene], timestep_s: float) -> Picture:
    """A column for each method, seen by one eye: as it leaves the layout, and after `LET_GO_S` of free simulation.

    Args:
        scenes: Results of the methods on one layout, by name.
        timestep_s: Of the simulation [s].
    """
    ids = sorted({body.object_id for scene in scenes.values() for body in scene.bodies})
    colors = {object_id: PALETTE[index % len(PALETTE)] for index, object_id in enumerate(ids)}
    at_first = {name: _scenery(scene, colors) for name, scene in scenes.items()}
    later = {
        f"{name}, {LET_GO_S:g} s later": _scenery(after(scene, LET_GO_S, timestep_s), colors)
        for name, scene in scenes.items()
    }
    eye = _eye(list(at_first.values()))
    return joined([_row(at_first, eye), _row(later, eye)], axis=0)


def _eye(sceneries: Sequence[Scenery]) -> Eye:
    """Sees every object of all of them."""
    names = tuple(name for scenery in sceneries for name in scenery.names)
    parts = tuple(part for scenery in sceneries for part in scenery.parts[:-1])
    return front_eye(Scenery(names, parts, tuple(None for _ in parts)), WIDTH, HEIGHT, _AZIMUTH)


def _row(sceneries: Mapping[str, Scenery], eye: Eye) -> Picture:
    panels = (
        _captioned(pictures(scenery, (eye,), QUALITY)[0].color, caption) for caption, scenery in sceneries.items()
    )
    return joined(list(panels), axis=1)


def _scenery(scene: ReleasedScene, colors: Mapping[str, Rgb]) -> Scenery:
    """The objects in their own colours where the mesh has some, on a table that fills the picture."""
    meshes = [placed_mesh(body.mesh, body.pose) for body in scene.bodies]
    slab = scene.slab
    wide = Slab(slab.center_xy, slab.half_size_xy + _TABLE_MARGIN_M, slab.yaw, slab.color)
    names = [body.object_id for body in scene.bodies]
    scenery = scenery_of(names, meshes, wide)
    worn = (None if _has_colors(mesh) else colors[name] for mesh, name in zip(meshes, names, strict=True))
    return replace(scenery, colors=(*worn, slab.color))


def _has_colors(mesh: TriangleMesh) -> bool:
    return mesh.vertex_colors is not None or mesh.texture is not None


def _captioned(picture: Picture, text: str) -> Picture:
    image = Image.new("RGB", (picture.shape[1], picture.shape[0] + _CAPTION), "white")
    image.paste(Image.fromarray(np.array(picture)), (0, _CAPTION))
    font = ImageFont.load_default(size=15)
    ImageDraw.Draw(image).text((2, 2), text, fill="black", font=font)
    captioned: Picture = np.asarray(image)
    return captioned
