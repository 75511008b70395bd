"""Data of every process of a training: meshes, textures, and the makers of scenes."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.evaluation.training.picture.exposure import Renderer
from tableverse_factory.evaluation.training.picture.flat_pictures import draw_flat_block
from tableverse_factory.evaluation.training.picture.materials import TextureBook
from tableverse_factory.evaluation.training.picture.patterns import BLOCKS, Textures, draw_block
from tableverse_factory.evaluation.training.picture.pool import MeshPool
from tableverse_factory.evaluation.training.picture.scenes import SceneMaker
from tableverse_factory.evaluation.training.picture.settings import PictureSettings
from tableverse_factory.evaluation.training.picture.tables import MeshTables, make_tables

MESHES_AT_A_TIME = 64


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """Meshes, textures and flat pictures, and the makers of training and validation scenes."""

    tables: MeshTables
    textures: Textures
    flat: Textures
    training: SceneMaker
    validation: SceneMaker

    def make_renderer(self, settings: PictureSettings, device: str) -> Renderer:
        """Make the renderer of a device: the path tracer on a GPU, embree on a CPU."""
        if device == "cuda":
            from tableverse_factory.evaluation.training.picture.render_cuda import CudaRenderer

            return CudaRenderer(self.tables, self.textures, settings.size, settings.samples)
        from tableverse_factory.evaluation.training.picture.render_cpu import CpuRenderer

        return CpuRenderer(self.tables, settings.size)


def make_world(pool: Path, settings: PictureSettings, jobs: int) -> World:
    """Build the meshes' trees and draw the textures, in `jobs` processes."""

    def spread(work: Callable[[Any], Any], items: Iterable[Any]) -> Iterable[Any]:
        return parallel_map(work, list(items), jobs, "builds trees", MESHES_AT_A_TIME)

    tables = make_tables(MeshPool.read(pool), settings.seed, spread)
    draw = partial(draw_block, settings.seed, settings.packages, settings.patterns)
    blocks = list(parallel_map(draw, range(BLOCKS), jobs, "draws textures"))
    printed, plain = zip(*blocks, strict=True)
    textures = np.concatenate([*printed, *plain])
    shown = parallel_map(partial(draw_flat_block, settings.seed, settings.flat), range(BLOCKS), jobs, "draws pictures")
    book = TextureBook(settings.packages, settings.patterns)
    training, validation = SceneMaker.hold_out(tables, book, settings.size)
    return World(tables, textures, np.concatenate([*shown]), training, validation)
