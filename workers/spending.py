"""What a build spent on questions to models, written down beside its records by whoever spends it, as it is spent.

A line per entry in a file per process; in a store an object per entry, whose name says it all, so that they need only
be listed. No kill loses any of it: a request is written down before it is sent.
"""

import os
import secrets
from pathlib import Path

from upath import UPath

from schemas.outcome import NOTHING, Spent
from tableverse_factory.errors import BuildError, ModelAccessError
from tableverse_factory.storage import Place, names_in, read_whole, write_atomic

FOLDER = "spent"
"""Below the records."""


class SpendingLog:
    """Where one process writes down what it spends."""

    def __init__(self, records: Place) -> None:
        """Nothing is made until something is spent."""
        self._folder = records / FOLDER
        self._name = secrets.token_hex(8)
        self._count = 0
        self._descriptor = -1

    def add(self, spent: Spent) -> None:
        """Writes it down.

        Raises:
            ModelAccessError: if the disk or the store refuses: nothing is spent that nobody counts.
        """
        entry = f"{spent.calls}_{spent.input_tokens}_{spent.output_tokens}_{spent.usd!r}"
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
            os.write(self._descriptor, f"{entry}\n".encode())
        except (OSError, BuildError) as error:
            why = (error.strerror if isinstance(error, OSError) else "") or error
            raise ModelAccessError(f"what is spent cannot be written down in {self._folder}: {why}") from error


def spent_so_far(records: Place) -> Spent:
    """What all processes have written down; a line that a kill or a full disk cut off counts for nothing.

    Raises:
        BuildError: if it cannot be read.
    """
    folder = records / FOLDER
    names = names_in(folder)
    if isinstance(folder, UPath):
        entries = [name.split("_")[2:] for name in names]
    else:
        try:
            lines = [line for name in names for line in read_whole(folder / name).decode().split("\n")[:-1]]
        except (OSError, UnicodeDecodeError) as error:
            raise BuildError(f"{folder} cannot be read: {error}") from error
        entries = [line.split("_") for line in lines]
    return sum((_entry(parts) for parts in entries), NOTHING)


def _entry(parts: list[str]) -> Spent:
    try:
        calls, read, written, usd = parts
        return Spent(int(calls), int(read), int(written), float(usd))
    except ValueError:
        return NOTHING
