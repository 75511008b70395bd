"""Picture of the paper's ablation: one layout after each method, and after half a second of simulation."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from schemas.config import Config
from schemas.geometry import Picture
from tableverse_factory.evaluation.bench.free_simulation import ReleasedScene, simulate_freely
from tableverse_factory.evaluation.bench.layouts import read_case
from tableverse_factory.evaluation.bench.rectifiers import RECTIFICATION_METHODS
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.physics.mjcf.scenery import Rgb, Scenery, make_scenery
from tableverse_factory.physics.mjcf.slab import Slab
from tableverse_factory.physics.render.views import RenderQuality, make_front_camera, render_pictures

LET_GO_S = 0.5  # simulated time of the lower row [s]
WIDTH, HEIGHT = 400, 276
QUALITY = RenderQuality(samples=2, sky_rays=6)
PALETTE: tuple[Rgb, ...] = (  # sRGB of objects whose mesh has no colours, in turn; neighbours are easy to tell apart
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
_AZIMUTH = float(np.deg2rad(28.0))
_TABLE_MARGIN_M = 0.25
_CAPTION = 24
GUTTER = 6  # white between two panels [px]


def write_ablation(file: Path, layout: Path, methods: Sequence[str], config: Config, cache_dir: Path) -> None:
    """Run methods (keys of `RECTIFICATION_METHODS`) on one layout and draw the results as a PNG file."""
    case = read_case(layout, None, config, cache_dir)
    scenes = {name: RECTIFICATION_METHODS[name](case, config).scene for name in methods}
    Image.fromarray(np.array(draw_ablation(scenes, config.settle.timestep_s))).save(file, format="PNG", optimize=True)


def draw_ablation(scenes: Mapping[str, ReleasedScene], timestep_s: float) -> Picture:
    """Draw a column for each method with one camera: its result, and below `LET_GO_S` of free simulation later."""
    ids = sorted({body.object_id for scene in scenes.values() for body in scene.bodies})
    colors = {object_id: PALETTE[index % len(PALETTE)] for index, object_id in enumerate(ids)}
    at_first = {name: _build_scenery(scene, colors) for name, scene in scenes.items()}
    later = {
        f"{name}, {LET_GO_S:g} s later": _build_scenery(simulate_freely(scene, LET_GO_S, timestep_s), colors)
        for name, scene in scenes.items()
    }
    eye = _frame_scenes(list(at_first.values()))
    return stack_panels([_draw_row(at_first, eye), _draw_row(later, eye)], axis=0)


def stack_panels(panels: Sequence[Picture], axis: int) -> Picture:
    """Stack panels of one size down (axis 0) or to the right (axis 1), with white gutters between them."""
    shape = list(panels[0].shape)
    shape[axis] = GUTTER
    gutter = np.full(shape, 255, dtype=np.uint8)
    return np.concatenate([part for panel in panels for part in (gutter, panel)][1:], axis=axis)


def _frame_scenes(sceneries: Sequence[Scenery]) -> PosedCamera:
    names = tuple(name for scenery in sceneries for name in scenery.names)
    parts = tuple(part for scenery in sceneries for part in scenery.parts[:-1])
    return make_front_camera(Scenery(names, parts, tuple(None for _ in parts)), WIDTH, HEIGHT, _AZIMUTH)


def _draw_row(sceneries: Mapping[str, Scenery], eye: PosedCamera) -> Picture:
    panels = (
        _add_caption(render_pictures(scenery, (eye,), QUALITY)[0].color, caption)
        for caption, scenery in sceneries.items()
    )
    return stack_panels(list(panels), axis=1)


def _build_scenery(scene: ReleasedScene, colors: Mapping[str, Rgb]) -> Scenery:
    """Give objects without colours one of the palette; widen the table to fill the picture."""
    meshes = [place_mesh(body.mesh, body.pose) for body in scene.bodies]
    slab = scene.slab
    wide = Slab(slab.center_xy, slab.half_size_xy + _TABLE_MARGIN_M, slab.yaw, slab.color)
    names = [body.object_id for body in scene.bodies]
    scenery = make_scenery(names, meshes, wide)
    plain = [mesh.vertex_colors is None and mesh.texture is None for mesh in meshes]
    worn = (colors[name] if its else None for name, its in zip(names, plain, strict=True))
    return replace(scenery, colors=(*worn, slab.color))


def _add_caption(picture: Picture, text: str) -> Picture:
    image = Image.new("RGB", (picture.shape[1], picture.shape[0] + _CAPTION), "white")
    image.paste(Image.fromarray(np.array(picture)), (0, _CAPTION))
    font = ImageFont.load_default(size=15)
    ImageDraw.Draw(image).text((2, 2), text, fill="black", font=font)
    return np.asarray(image)
