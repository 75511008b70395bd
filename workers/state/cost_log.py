"""Log of what a build spent on requests to models, written before each request is sent, so that no kill loses any.

It has its own folder in OUT and survives the removal of checkpoints and work: nothing else remembers the costs. On the
disk each process appends lines to a file; in a store each entry is an object whose name holds it, so listing suffices.
"""

import errno
import os
import secrets
from collections import defaultdict
from pathlib import Path

from upath import UPath

from schemas.outcome import NO_COST, ModelCost
from tableverse_factory.core.errors import BuildError, ModelAccessError
from tableverse_factory.core.storage.files import StoragePath, list_names, read_whole, write_atomic

FOLDER = ".spent"


class CostLog:
    """Cost log of one process."""

    def __init__(self, out: StoragePath) -> None:
        """Nothing is created until something is spent."""
        self.grant = ""  # name of the allowance that is being spent
        self._folder = out / FOLDER
        self._name = secrets.token_hex(8)
        self._count = 0
        self._descriptor = -1

    def add(self, cost: ModelCost) -> None:
        """Append an entry; ModelAccessError if the disk or the store refuses: uncounted requests must not be sent."""
        entry = f"{self.grant}_{cost.calls}_{cost.input_tokens}_{cost.output_tokens}_{cost.usd!r}_"
        try:
            if isinstance(self._folder, UPath):
                self._count += 1
                write_atomic(self._folder / f"{self._name}_{self._count}_{entry}", b"\n")
                return
            if self._descriptor < 0:
                folder = Path(str(self._folder))
                folder.mkdir(parents=True, exist_ok=True)
                flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC
                self._descriptor = os.open(folder / self._name, flags, 0o644)
            line = f"\n{entry}".encode()  # a torn entry before it stays a line of its own
            if os.write(self._descriptor, line) < len(line):
                raise OSError(errno.ENOSPC, "the disk took only a part of it")
        except (OSError, BuildError) as error:
            why = (error.strerror if isinstance(error, OSError) else "") or error
            raise ModelAccessError(f"what is spent cannot be written down in {self._folder}: {why}") from error


def sum_costs(out: StoragePath) -> ModelCost:
    """Sum the entries of all processes."""
    return sum(sum_costs_by_grant(out).values(), NO_COST)


def sum_costs_by_grant(out: StoragePath) -> dict[str, ModelCost]:
    """Sum the entries of all processes by the allowance that was spent; torn entries do not count."""
    folder = out / FOLDER
    names = list_names(folder)
    if isinstance(folder, UPath):
        entries = [name.split("_")[2:] for name in names]
    else:
        try:
            lines = [line for name in names for line in read_whole(folder / name).decode().split("\n")]
        except (OSError, UnicodeDecodeError) as error:
            raise BuildError(f"{folder} cannot be read: {error}") from error
        entries = [line.split("_") for line in lines]
    sums: defaultdict[str, ModelCost] = defaultdict(ModelCost)
    for parts in entries:
        if cost := _parse_entry(parts):
            sums[parts[0]] += cost
    return dict(sums)


def _parse_entry(parts: list[str]) -> ModelCost:
    try:
        _grant, calls, read, written, usd, _end = parts
        return ModelCost(int(calls), int(read), int(written), float(usd))
    except ValueError:
        return NO_COST
