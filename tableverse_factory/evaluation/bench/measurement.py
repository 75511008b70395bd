"""Shared by the benches: CPU time by part, and their inputs or an even sample of them."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np

from tableverse_factory.geometry.mesh.meshes import MESH_SUFFIXES

Item = TypeVar("Item")


class Stopwatch:
    """CPU time of this process by part, in the order of first use [s]."""

    def __init__(self) -> None:
        self.cpu_s: dict[str, float] = {}

    @contextmanager
    def measure(self, part: str, repeats: int = 1) -> Iterator[None]:
        """Add the CPU time of the block to a part, divided by the number of repeats that the part consists of."""
        started = time.process_time()
        yield
        self.cpu_s[part] = self.cpu_s.get(part, 0.0) + (time.process_time() - started) / repeats


def find_meshes(folder: Path, most: int | None = None) -> list[Path]:
    """Find the meshes of a folder in the order of their names, at most `most`, spread evenly."""
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in MESH_SUFFIXES and path.is_file())
    return sample_evenly(found, most)


def sample_evenly(items: Sequence[Item], most: int | None) -> list[Item]:
    """Return at most `most` items, spread evenly from the first to the last; all of them for None."""
    if most is None or len(items) <= most:
        return list(items)
    return [items[index] for index in np.linspace(0, len(items) - 1, most).round().astype(int).tolist()]
