"""Journal of a run: the file that rows are appended to until the results are written, locked by the process."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from tableverse_factory.core.errors import BuildError, InputError
from tableverse_factory.core.text import describe_change
from tableverse_factory.evaluation.benchmark.results import (
    EpisodeResult,
    ResultsHeader,
    decode_results,
    encode_line,
    read_results,
)


@contextmanager
def open_journal(out: Path, header: ResultsHeader) -> Iterator[tuple[BinaryIO, dict[str, EpisodeResult]]]:
    """Open the journal of the results `out`, with the rows that both hold; the run removes it when `out` is written.

    If the run ends before, it stays with its rows; without any it is removed.

    Raises:
        BuildError: if another process has it open.
        InputError: `other_results` if either is of another benchmark or policy.
    """
    with _lock_file(out) as file:
        known = dict(read_results(out)[1]) if _is_of_run(out, header) else {}
        file.seek(0)
        data = file.read()
        whole = data[: data.rfind(b"\n") + 1]  # a killed process may have torn its last line
        file.truncate(len(whole))
        found, rows = decode_results(whole, file.name) if whole else (header, {})
        if rows:
            _check_header(Path(file.name), found, header)
            known |= rows
        else:
            file.truncate(0)
            file.write(encode_line(header))
            file.flush()
        try:
            yield file, known
        finally:
            _drop_header(file)


def _drop_header(file: BinaryIO) -> None:
    """Empty a journal that holds a header and no whole row."""
    file.seek(0)
    if not (file.readline() and file.readline().endswith(b"\n")):
        file.truncate(0)


@contextmanager
def _lock_file(out: Path) -> Iterator[BinaryIO]:
    path = out.with_name(f"{out.name}.journal")
    path.parent.mkdir(parents=True, exist_ok=True)
    while True:
        with path.open("a+b") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise BuildError(
                    f"{out}: another process writes these results; wait for it, or give another --out"
                ) from None
            if _is_at(path, file):
                try:
                    yield file
                finally:  # others that wait for the lock see then that the file is gone
                    if _is_at(path, file) and not path.stat().st_size:
                        path.unlink()
                return


def _is_at(path: Path, file: BinaryIO) -> bool:
    """Whether this is still the file of that name: a run that ended since it was opened has removed it."""
    try:
        return os.path.samestat(path.stat(), os.fstat(file.fileno()))
    except FileNotFoundError:
        return False


def _is_of_run(out: Path, header: ResultsHeader) -> bool:
    if not out.exists():
        return False
    _check_header(out, read_results(out)[0], header)
    return True


def _check_header(path: Path, found: ResultsHeader, header: ResultsHeader) -> None:
    """Refuse results of another run; weights that were moved are the same ones."""
    if found.model_copy(update={"weights": header.weights}) == header:
        return
    changes = [
        describe_change(name, getattr(found, name), getattr(header, name))
        for name in ResultsHeader.model_fields
        if name not in ("policy_digest", "weights") and getattr(found, name) != getattr(header, name)
    ]
    (old, _, _), (new, _, _) = (each.weights.partition(", ") for each in (found, header))  # digests, without names
    if old and old != new:
        changes.append(describe_change("weights", found.weights, header.weights))
    elif found.policy_digest != header.policy_digest:
        what = "the policy's code" if old == new else "the policy's code or weights"
        changes.append(describe_change(f"the digest of {what}", found.policy_digest[:12], header.policy_digest[:12]))
    raise InputError(
        f"{path} holds results of another run: {'; '.join(changes)}. Give the same, or another --out, or remove it",
        "other_results",
    )
