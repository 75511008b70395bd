"""Rendering of training views on a GPU: `tracer.cu` through CuPy, on torch's memory and stream."""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8

from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.evaluation.training.picture.builder import SceneTables
from tableverse_factory.evaluation.training.picture.exposure import Exposure
from tableverse_factory.evaluation.training.picture.tables import MeshTables
from tableverse_factory.models.local.device import import_torch

BLOCK = 8  # side of a block of threads [px]


class CudaRenderer:
    """Path-traces packs of views on the current CUDA device."""

    def __init__(
        self, tables: MeshTables, textures: UInt8[np.ndarray, "n s s 3"], size: tuple[int, int], samples: int
    ) -> None:
        self._torch = import_torch()
        self._cupy: Any = import_extra("cupy", "rendering on a GPU", "training")
        self._device = self._cupy.cuda.Device(self._torch.cuda.current_device())  # that CuPy does not know by itself
        source = Path(__file__).with_name("tracer.cu").read_text()
        module = self._cupy.RawModule(code=source, options=("--use_fast_math", "--std=c++17"))
        with self._device:
            self._kernel = module.get_function("render")
        self._world = [self._to_device(each) for each in (tables.nodes, tables.triangles, tables.normals)]
        self._textures = self._to_device(textures)
        self._size, self._samples = size, samples

    def render(self, pack: SceneTables) -> Exposure:
        """Render every view of the pack."""
        torch, (width, height), count = self._torch, self._size, len(pack.views)
        rows = [self._to_device(each) for each in (pack.instances, pack.materials, pack.scenes, pack.lights)]
        views = self._to_device(pack.views)
        shape = (count, height, width)
        out = Exposure(
            torch.empty(*shape, 9, device="cuda"),
            torch.empty(shape, device="cuda"),
            torch.empty(shape, dtype=torch.uint8, device="cuda"),
            torch.empty(*shape, 3, dtype=torch.int8, device="cuda"),
            torch.empty(shape, dtype=torch.uint8, device="cuda"),
        )
        inputs = [np.uint64(each.data_ptr()) for each in (*self._world, *rows, self._textures)]
        outputs = [np.uint64(each.data_ptr()) for each in (out.light, out.depth, out.ids, out.normals, out.shine)]
        side, numbers = np.int32(self._textures.shape[1]), [np.int32(v) for v in (count, width, height, self._samples)]
        grid = (-(-width // BLOCK), -(-height // BLOCK), count)
        with self._device, self._cupy.cuda.ExternalStream(torch.cuda.current_stream().cuda_stream):
            arguments = (*inputs, side, np.uint64(views.data_ptr()), *numbers, *outputs)
            self._kernel(grid, (BLOCK * BLOCK,), arguments)
        return out

    def _to_device(self, array: np.ndarray) -> Any:
        return self._torch.tensor(array, device="cuda")
