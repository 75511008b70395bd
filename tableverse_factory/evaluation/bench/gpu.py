"""What a GPU did meanwhile: how busy it was, and the most memory that torch held."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from tableverse_factory.models.local.device import Device, torch_here

EVERY_MS = 100
_END_S = 10.0


@dataclass(slots=True)
class Seen:
    """Of one GPU while a block ran; None where there is none, or no nvidia-smi that tells.

    Attributes:
        busy: Mean share of the time in which a kernel ran, by nvidia-smi.
        peak_bytes: Most memory that torch held.
    """

    busy: float | None = None
    peak_bytes: int | None = None


@contextmanager
def watched(device: Device) -> Iterator[Seen]:
    """Watches the device until the block ends; what was seen is there afterwards."""
    seen = Seen()
    if device.kind == "cpu":
        yield seen
        return
    cuda = torch_here().cuda
    cuda.synchronize()
    cuda.reset_peak_memory_stats()
    sampler = _sampler(str(cuda.get_device_properties(cuda.current_device()).uuid))
    try:
        yield seen
        cuda.synchronize()
        seen.peak_bytes = int(cuda.max_memory_allocated())
    finally:
        seen.busy = _mean(sampler)


def _sampler(uuid: str) -> subprocess.Popen[str] | None:
    """nvidia-smi, saying again and again how busy the GPU is [%]; None where there is none."""
    name = uuid if uuid.startswith("GPU-") else f"GPU-{uuid}"
    query = ["--query-gpu=utilization.gpu", "--format=csv,noheader,nounits", f"--loop-ms={EVERY_MS}"]
    try:
        return subprocess.Popen(
            ["nvidia-smi", f"--id={name}", *query], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
    except OSError:
        return None


def _mean(sampler: subprocess.Popen[str] | None) -> float | None:
    if sampler is None:
        return None
    sampler.terminate()
    said, _ = sampler.communicate(timeout=_END_S)
    samples = [int(line) for line in said.splitlines() if line.strip().isdigit()]
    return sum(samples) / len(samples) / 100 if samples else None
