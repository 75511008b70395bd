"""Shared by the benches: CPU time by part, and their inputs or an even sample of them."""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

import numpy as np

from schemas.geometry import TriangleMesh
from tableverse_factory.core.errors import GeometryError, InputError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.geometry.mesh.meshes import MESH_SUFFIXES, read_mesh

MOST_NAMED = 5  # of bad meshes in one message

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


def read_meshes(
    folder: Path, most: int | None = None, check: Callable[[str, TriangleMesh], None] = lambda _name, _mesh: None
) -> list[tuple[str, TriangleMesh]]:
    """Read the named meshes of a folder into memory in the order of their names, at most `most`, spread evenly.

    Raises:
        InputError: if there is none, or naming those together that cannot be read or that `check` refuses, which gets
            their printable names.
    """
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in MESH_SUFFIXES and path.is_file())
    if not found:
        raise InputError(
            f"{sanitize_line(str(folder))} holds no meshes: give a folder of {', '.join(MESH_SUFFIXES)} files"
        )
    meshes, errors = [], []
    for path in sample_evenly(found, most):
        name = sanitize_line(path.name)
        try:
            mesh = read_mesh(path.read_bytes(), path.name)
            check(name, mesh)
        except OSError as error:
            errors.append(f"{name}: {error.strerror}")
        except (InputError, GeometryError) as error:
            errors.append(str(error))
        else:
            meshes.append((path.name, mesh))
    if errors:
        more = f"; and {len(errors) - MOST_NAMED} more" if len(errors) > MOST_NAMED else ""
        raise InputError("; ".join(errors[:MOST_NAMED]) + more)
    return meshes


def sample_evenly(items: Sequence[Item], most: int | None) -> list[Item]:
    """Return at most `most` items, spread evenly from the first to the last; all of them for None."""
    if most is None or len(items) <= most:
        return list(items)
    return [items[index] for index in np.linspace(0, len(items) - 1, most).round().astype(int).tolist()]
