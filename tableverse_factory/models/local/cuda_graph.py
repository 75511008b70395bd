"""A model's forward as one launch: a GPU replays what it did the first time, instead of being told kernel by kernel."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from tableverse_factory.models.local.device import Device, Tensor, torch_here

Forward = Callable[..., tuple[Tensor, ...]]
"""Tensors to tensors, of shapes that follow from theirs, all on the device; nothing waits for it inside."""

WARM_UPS = 2
"""Calls before it is recorded: libraries make their handles and choose their kernels in the first."""


@dataclass(frozen=True, slots=True)
class _Recording:
    graph: Any
    inputs: tuple[Tensor, ...]
    outputs: tuple[Tensor, ...]


class CudaGraphRunner:
    """A forward, recorded once for each set of shapes; the same kernels in the same order give the same numbers.

    Telling a GPU of two thousand kernels costs the CPU 50 to 90 ms however few pictures they are for. A CPU has nothing
    to record, and is asked anew each time.
    """

    def __init__(self, forward: Forward, device: Device) -> None:
        """Takes what is to be recorded when it is first called."""
        self._forward, self._on_gpu = forward, device.kind == "cuda"
        self._recordings: dict[tuple[tuple[int, ...], ...], _Recording] = {}

    def __call__(self, *inputs: Tensor) -> tuple[Tensor, ...]:
        """Its answer, in tensors that the next call with such shapes writes anew."""
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

    def forget(self) -> None:
        """Lets go of every recording and its memory: as much as its forward needs, for as long as it is kept."""
        if self._recordings:
            torch_here().cuda.synchronize()
        self._recordings.clear()

    def _record(self, inputs: tuple[Tensor, ...]) -> _Recording:
        cuda = torch_here().cuda
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
