"""CUDA graph of a model's forward pass: one launch replays all kernels."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tableverse_factory.models.local.device import Device, Tensor, import_torch

# Tensors to tensors on the device; output shapes follow from input shapes, and it does not synchronize.
Forward = Callable[..., tuple[Tensor, ...]]
WARM_UPS = 2  # calls before recording, in which libraries create their handles and choose their kernels


@dataclass(frozen=True, slots=True)
class _Recording:
    graph: Any
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]


class CudaGraphRunner:
    """A forward pass recorded once for each set of shapes; the same kernels in the same order give the same numbers.

    Launching two thousand kernels costs the CPU 50 to 90 ms whatever the batch size. On a CPU nothing is recorded.
    """

    def __init__(self, forward: Forward, device: Device) -> None:
        self._forward, self._on_gpu = forward, device.kind == "cuda"
        self._recordings: dict[tuple[tuple[int, ...], ...], _Recording] = {}

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Run the forward pass; the next call with the same shapes overwrites the returned tensors."""
        if not self._on_gpu:
            return self._forward(*inputs)
        shapes = tuple(tuple(tensor.shape) for tensor in inputs)
        if shapes not in self._recordings:
            self._recordings[shapes] = self._record(inputs)
        recording = self._recordings[shapes]
        for own, given in zip(recording.inputs, inputs, strict=True):
            own.copy_(given, non_blocking=True)
        recording.graph.replay()
        return recording.outputs

    def reset(self) -> None:
        """Drop every recording and its memory, as much as its forward pass needs."""
        if self._recordings:
            import_torch().cuda.synchronize()
        self._recordings.clear()

    def _record(self, inputs: tuple[Tensor, ...]) -> _Recording:
        cuda = import_torch().cuda
        own = tuple(tensor.clone() for tensor in inputs)
        aside = cuda.Stream()
        aside.wait_stream(cuda.current_stream())
        with cuda.stream(aside):
            for _ in range(WARM_UPS):
                self._forward(*own)
        cuda.current_stream().wait_stream(aside)
        graph = cuda.CUDAGraph()
        with cuda.graph(graph, capture_error_mode="thread_local"):  # other threads may go on asking for pinned memory
            outputs = self._forward(*own)
        return _Recording(graph, own, outputs)
