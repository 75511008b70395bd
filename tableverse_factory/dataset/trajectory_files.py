"""Files of a scene's trajectories: their names, and whether rows and files belong together."""

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any

from schemas.identity import check_id
from schemas.scene import ExportedScene
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import sanitize_line

FOLDER = "trajectories/"  # folder of a scene for what came after the export, which is not in `meta.json`

Row = Mapping[str, Any]


def arrays_name(task_id: str) -> str:
    """Name of the file with the arrays of a task's motion, e.g. `trajectories/task_000.npz`."""
    return f"{FOLDER}{check_id(task_id)}.npz"


def strip_motions(files: Sequence[tuple[str, bytes]]) -> tuple[tuple[str, bytes], ...]:
    """Remove the files that came after the export."""
    return tuple((name, data) for name, data in files if not name.startswith(FOLDER))


def add_trajectories(
    scene: ExportedScene, rows: Sequence[Row], files: Mapping[str, bytes] = MappingProxyType({})
) -> ExportedScene:
    """Return the scene with these rows of trajectories/, and the files that they name."""
    counts = {"n_trajectories": len(rows), "n_successes": sum(bool(row["success"]) for row in rows)}
    return replace(
        scene,
        files=tuple(sorted({**dict(scene.files), **files}.items())),
        scene_row={**scene.scene_row, **counts},
        trajectory_rows=tuple(add_digests(rows, tuple(files.items()))),
    )


def add_digests(rows: Sequence[Row], files: Sequence[tuple[str, bytes]]) -> list[dict[str, Any]]:
    """Add to each row the SHA-256 of the file that it names."""
    data_of = dict(files)
    return [{**row, "arrays_sha256": _hash(data_of[row["arrays"]]) if row.get("arrays") else None} for row in rows]


def check_digest(data: bytes, row: Row) -> bytes:
    """Return the file of a row of trajectories/ if it is the one written; InputError `bad_arrays` if not."""
    if _hash(data) != row.get("arrays_sha256"):
        name = sanitize_line(str(row["arrays"]), 100)
        raise InputError(
            f"{name} is not the file that was written: its SHA-256 differs from arrays_sha256 in its row; "
            "`tableverse verify` says what else was changed",
            "bad_arrays",
        )
    return data


def find_misfits(rows: Sequence[Row], files: Mapping[str, bytes], task_ids: Sequence[str]) -> Iterator[str]:
    """Find what does not fit between a scene's trajectory rows, its tasks and its files; one line each."""
    seen: set[str] = set()
    for row in rows:
        task_id, named = row.get("task_id"), row.get("arrays")
        if not isinstance(task_id, str) or task_id not in task_ids or task_id in seen:
            yield f"a trajectory of {task_id!r:.80}, which is none of the scene's tasks or stands there already"
            continue
        seen.add(task_id)
        if named is not None and (named not in files or named != f"{FOLDER}{task_id}.npz"):
            yield f"{named!r:.80} is not the file of {task_id!r:.80}, or not among the scene's files"
        if row.get("success") and named is None:
            yield f"{task_id!r:.80} succeeded, and no file holds its motion"
    yield from _find_unclaimed(rows, files)


def find_changes(rows: Sequence[Row], files: Mapping[str, bytes], scene: Row) -> Iterator[str]:
    """Find what has changed or is lost since the scene was written; one line each."""
    if len(rows) != (scene.get("n_trajectories") or 0):
        yield f"trajectories/ has {len(rows)} rows of it, and scenes/ says {scene.get('n_trajectories') or 0}"
    for row in rows:
        named = row["arrays"]
        if named is not None and (named not in files or _hash(files[named]) != row["arrays_sha256"]):
            yield f"{named!r:.80} is not the file that was written"
    yield from _find_unclaimed(rows, files)


def _find_unclaimed(rows: Sequence[Row], files: Mapping[str, bytes]) -> Iterator[str]:
    claimed = {row.get("arrays") for row in rows}
    yield from (f"{name!r:.80} belongs to no row" for name in files if name.startswith(FOLDER) and name not in claimed)


def _hash(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()
