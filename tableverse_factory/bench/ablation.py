"""The paper's ablation as a picture: what each method makes of one layout, and what half a second makes of that."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from schemas.config import Config
from schemas.geometry import Picture
from tableverse_factory.bench.layouts import read_case
from tableverse_factory.bench.rectifiers import METHODS
from tableverse_factory.bench.release import Scene, after
from tableverse_factory.geometry.meshes import placed_mesh
from tableverse_factory.physics.scenery import Scenery, scenery_of
from tableverse_factory.physics.tabletop import Slab
from tableverse_factory.physics.views import Eye, Quality, front_eye, pictures

LET_GO_S = 0.5
"""How long the lower row was simulated, freely [s]."""
WIDTH, HEIGHT = 400, 276
QUALITY = Quality(samples=2, sky_rays=6)
PALETTE = (
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
_GUTTER, _CAPTION = 6, 24


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


def ablation(scenes: Mapping[str, Scene], timestep_s: float) -> Picture:
    """A column for each method, seen by one eye: as it leaves the layout, and after `LET_GO_S` of free simulation.

    Args:
        scenes: Results of the methods on one layout, by name.
        timestep_s: Of the simulation [s].
    """
    eye = _eye(list(scenes.values()))
    at_first = [_captioned(_seen(scene, eye), name) for name, scene in scenes.items()]
    later = [
        _captioned(_seen(after(scene, LET_GO_S, timestep_s), eye), f"{name}, {LET_GO_S:g} s later")
        for name, scene in scenes.items()
    ]
    return _joined([_joined(at_first, axis=1), _joined(later, axis=1)], axis=0)


def _eye(scenes: Sequence[Scene]) -> Eye:
    """Sees every object of every scene."""
    drawn = [_scenery(scene) for scene in scenes]
    names = [name for scenery in drawn for name in scenery.names]
    meshes = [part for scenery in drawn for part in scenery.parts[:-1]]
    return front_eye(scenery_of(names, meshes, scenes[0].slab), WIDTH, HEIGHT, _AZIMUTH)


def _seen(scene: Scene, eye: Eye) -> Picture:
    return pictures(_scenery(scene), (eye,), QUALITY)[0].color


def _scenery(scene: Scene) -> Scenery:
    meshes = [placed_mesh(body.mesh, body.pose) for body in scene.bodies]
    slab = scene.slab
    wide = Slab(slab.center_xy, slab.half_size_xy + _TABLE_MARGIN_M, slab.yaw, slab.color)
    scenery = scenery_of([body.object_id for body in scene.bodies], meshes, wide)
    own = [mesh.vertex_colors is not None for mesh in meshes]
    colors = tuple(None if has else PALETTE[index % len(PALETTE)] for index, has in enumerate(own))
    return replace(scenery, colors=(*colors, scenery.colors[-1]))


def _captioned(picture: Picture, text: str) -> Picture:
    image = Image.new("RGB", (picture.shape[1], picture.shape[0] + _CAPTION), "white")
    image.paste(Image.fromarray(np.array(picture)), (0, _CAPTION))
    font = ImageFont.load_default(size=15)
    ImageDraw.Draw(image).text((2, 2), text, fill="black", font=font)
    captioned: Picture = np.asarray(image)
    return captioned


def _joined(panels: list[Picture], axis: int) -> Picture:
    shape = list(panels[0].shape)
    shape[axis] = _GUTTER
    gutter = np.full(shape, 255, dtype=np.uint8)
    pieces = [piece for panel in panels for piece in (gutter, panel)][1:]
    joined: Picture = np.concatenate(pieces, axis=axis)
    return joined
