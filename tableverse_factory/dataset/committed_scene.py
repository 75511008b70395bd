"""Scenes of a dataset as the records that they were written from, so that nothing finished is recomputed."""

from collections.abc import Hashable, Mapping, Sequence
from functools import lru_cache
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
from upath import UPath

from schemas.scene import ExportedScene
from schemas.work import ScenePart
from tableverse_factory.core.errors import BuildError, InputError
from tableverse_factory.core.storage.files import StoragePath, open_stream
from tableverse_factory.dataset.committed_rows import read_shard
from tableverse_factory.dataset.model_costs import COST_COLUMNS
from tableverse_factory.dataset.parts import read_part_files, read_part_rows
from tableverse_factory.dataset.scene_meta import read_meta
from tableverse_factory.dataset.shards import advise_repair, shard_path
from tableverse_factory.dataset.tar_members import read_scene_files
from tableverse_factory.dataset.trajectory_files import Row, strip_motions

# Columns of scenes/ that the commit adds to those of the scene itself
ADDED_BY_COMMIT = frozenset(
    {
        *("kind", "name", "url", "source", "uri", "licence", "licence_verdict", "content_sha256"),
        *("known_length", "parent", "recipe", "family", "split"),
        *("status", "stage", "reason", "error_kind", "detail", "attempts"),
        *COST_COLUMNS,
        *("n_trajectories", "n_successes", "shard", "tar_offset", "tar_size"),
    }
)


def load_exported_scene(out: StoragePath, shard: int, scene_id: str) -> ExportedScene | None:
    """Load a scene as it left `export`, without trajectories; None if it is not committed or has no files."""
    try:
        tables = _read_tables(out, shard, _read_version(shard_path(out, "scenes", shard)))
        scenes, objects, tasks = (table.filter(pc.equal(table["scene_id"], scene_id)).to_pylist() for table in tables)
        if not scenes or scenes[0]["tar_offset"] is None:
            return None
        files = _read_files(out, shard, scene_id, scenes[0])
    except FileNotFoundError:
        return None
    try:
        return _make_scene(scene_id, files, scenes[0], objects, tasks)
    except InputError as error:
        raise _damage_error(out, shard, f"{scene_id}: {error}") from error


def load_part(out: StoragePath, shard: int, scene_id: str, part: ScenePart) -> ExportedScene:
    """Load a finished scene that is not committed yet as it left `export`.

    Raises:
        FrameError: if its part is damaged.
        FileNotFoundError: if its part is gone.
    """
    rows = read_part_rows(out, shard, part)
    files = tuple(read_scene_files(scene_id, read_part_files(out, shard, part)).items())
    return _make_scene(scene_id, files, rows["scenes"][0], rows["objects"], rows["tasks"])


def _make_scene(
    scene_id: str, files: Sequence[tuple[str, bytes]], scene: Row, objects: Sequence[Row], tasks: Sequence[Row]
) -> ExportedScene:
    row = {name: None if name in ADDED_BY_COMMIT else value for name, value in scene.items()}
    certificate = read_meta(dict(files).get("meta.json", b"null")).certificate
    return ExportedScene(
        scene_id, strip_motions(files), certificate, row, tuple(map(dict, objects)), tuple(map(dict, tasks))
    )


@lru_cache(maxsize=1)
def _read_tables(out: StoragePath, shard: int, version: tuple[Hashable, ...]) -> tuple[pa.Table, ...]:  # noqa: ARG001
    """Read the tables of a shard, cached, as its scenes are loaded one after the other.

    The version is that of the table of scenes, which is removed first and written last when a shard is rewritten.
    """
    return tuple(read_shard(out, table, shard) for table in ("scenes", "objects", "tasks"))


def _read_version(path: StoragePath) -> tuple[Hashable, ...]:
    if isinstance(path, UPath):
        found = path.fs.info(path.path)
        return found["ETag"], found["LastModified"], found["size"]
    found = path.stat()
    return found.st_ino, found.st_mtime_ns, found.st_size


def _read_files(out: StoragePath, shard: int, scene_id: str, row: Mapping[str, Any]) -> tuple[tuple[str, bytes], ...]:
    with open_stream(shard_path(out, "mjcf", shard)) as tar:
        tar.seek(row["tar_offset"])
        data = tar.read(row["tar_size"])
    if len(data) != row["tar_size"]:
        raise _damage_error(out, shard, f"{scene_id} is cut short")
    try:
        return tuple(read_scene_files(scene_id, data).items())
    except InputError as error:
        raise _damage_error(out, shard, str(error)) from error


def _damage_error(out: StoragePath, shard: int, what: str) -> BuildError:
    path = shard_path(out, "mjcf", shard)
    return BuildError(f"{path} is damaged ({what}): {advise_repair(path)}")
