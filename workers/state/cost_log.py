"""What a build spent on questions to models, written down by whoever spends it, as it is spent.

It lies in a folder of its own in OUT and stays when records or work are cleared away: nothing else remembers it. A line
per entry in a file per process; in a store an object per entry, whose name says it all, so that they need only be
listed. No kill loses any of it: a request is written down before it is sent.
"""

import errno
import os
import secrets
from collections import defaultdict
from pathlib import Path

from upath import UPath

from schemas.outcome import NOTHING, Spent
from tableverse_factory.core.errors import BuildError, ModelAccessError
from tableverse_factory.core.storage.files import StoragePath, list_names, read_whole, write_atomic

FOLDER = ".spent"


class SpendingLog:
    """Where one process writes down what it spends.

    Attributes:
        grant: Name of the allowance that is being spent.
    """

    def __init__(self, out: StoragePath) -> None:
        """Nothing is made until something is spent."""
        self.grant = ""
        self._folder = out / FOLDER
        self._name = secrets.token_hex(8)
        self._count = 0
        self._descriptor = -1

    def add(self, spent: Spent) -> None:
        """Writes it down.

        Raises:
            ModelAccessError: if the disk or the store refuses: nothing is spent that nobody counts.
        """
        entry = f"{self.grant}_{spent.calls}_{spent.input_tokens}_{spent.output_tokens}_{spent.usd!r}_"
        try:
            if isinstance(self._folder, UPath):
                self._count += 1
                write_atomic(self._folder / f"{self._name}_{self._count}_{entry}", b"\n")
                return
            if self._descriptor < 0:
                folder = Path(str(self._folder))
                folder.mkdir(parents=True, exist_ok=True)
                self._descriptor = os.open(
                    folder / self._name, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644
                )
            line = f"\n{entry}".encode()  # what was cut off before it stays a line of its own
            if os.write(self._descriptor, line) < len(line):
                raise OSError(errno.ENOSPC, "the disk took only a part of it")
        except (OSError, BuildError) as error:
            why = (error.strerror if isinstance(error, OSError) else "") or error
            raise ModelAccessError(f"what is spent cannot be written down in {self._folder}: {why}") from error


def spent_so_far(out: StoragePath) -> Spent:
    """What all processes have written down.

    Raises:
        BuildError: if it cannot be read.
    """
    return sum(spent_by_grant(out).values(), NOTHING)


def spent_by_grant(out: StoragePath) -> dict[str, Spent]:
    """What all processes have written down, by the name of the allowance that it was spent of.

    An entry that a kill or a full disk cut off counts for nothing.

    Raises:
        BuildError: if it cannot be read.
    """
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
    sums: defaultdict[str, Spent] = defaultdict(Spent)
    for parts in entries:
        if spent := _spent(parts):
            sums[parts[0]] += spent
    return dict(sums)


def _spent(entry: list[str]) -> Spent:
    try:
        _grant, calls, read, written, usd, _end = entry
        return Spent(int(calls), int(read), int(written), float(usd))
    except ValueError:
        return NOTHING
