"""The dataset as its consumers see it: tables as pyarrow datasets, and scenes opened straight from their shard."""

import difflib
import re
from collections.abc import Mapping, Sequence
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import fsspec
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.dataset as ds
import pyarrow.fs
import pyarrow.parquet as pq
from fsspec.implementations.local import LocalFileSystem

from schemas.arrow import TABLES
from tableverse_factory.core.errors import InputError, StoreError
from tableverse_factory.core.storage.files import resolve_filesystem
from tableverse_factory.core.storage.parquet import make_arrow_filesystem, read_remote_table
from tableverse_factory.core.text import pluralize, sanitize_line
from tableverse_factory.dataset.consolidated_tables import MADE_FROM, MERGED, digest_shards
from tableverse_factory.dataset.scene import Scene
from tableverse_factory.dataset.shard_plan import PLAN
from tableverse_factory.dataset.shards import SPARSE
from tableverse_factory.dataset.tar_members import read_scene_files

__all__ = ["Dataset", "Scene", "open_dataset"]

MAX_SCENE_BYTES = 2 * 1024**3
_SHARD = re.compile(r"shard-(\d{5,9})\.parquet")


def open_dataset(path: str | Path) -> "Dataset":
    """Opens what `tableverse build` wrote, finished or not.

    Args:
        path: A folder, `s3://bucket/prefix`, `https://host/folder`, `hf://datasets/OWNER/NAME` (with `@REVISION` where
            another than `main` is meant), or any other fsspec URI.

    Raises:
        InputError: if there is no dataset at `path`.
    """
    try:
        filesystem, root = _filesystem(str(path))
        there = filesystem.isdir(root)
    except StoreError as error:
        raise InputError(str(error)) from None
    except (OSError, ValueError, ImportError) as error:
        raise InputError(f"{path}: cannot be reached: {sanitize_line(str(error), 300)}") from None
    if not there:
        raise InputError(f"{path}: no such folder; give the OUT of `tableverse build`")
    if not filesystem.exists(f"{root}/run.json") and not filesystem.isdir(f"{root}/scenes"):
        raise InputError(f"{path}: neither run.json nor scenes/ in it; {_nearby(str(path))}")
    return Dataset(str(path), filesystem, root)


def _nearby(path: str) -> str:
    """Which folder was meant: one above, or the only one in it, that holds a build."""
    folder = Path(path)
    meant = [above for above in folder.absolute().parents[:2] if (above / "run.json").is_file()]
    meant += sorted(record.parent for record in folder.glob("*/run.json"))
    return f"did you mean {meant[0]}?" if len(meant) == 1 else "give the OUT of `tableverse build`"


def _filesystem(path: str) -> tuple[fsspec.AbstractFileSystem, str]:
    scheme = path.partition("://")[0]
    if scheme in ("http", "https"):
        from tableverse_factory.dataset.http_dataset import WebFolder, check_web_address

        folder = WebFolder(check_web_address(path))
        return folder, folder.address
    if scheme == "hf":
        from tableverse_factory.dataset.hub_folder import open_hub_folder

        folder = open_hub_folder(path)
        return folder, folder.address
    return resolve_filesystem(path)


class Dataset:
    """A dataset at rest. Only committed shards count: those whose file in scenes/ exists.

    The shards are listed once, when a table is first asked for; open the dataset again to see newer ones.
    """

    def __init__(self, path: str, filesystem: fsspec.AbstractFileSystem, root: str) -> None:
        self.path = path
        self._filesystem = filesystem
        self._root = root.rstrip("/")
        # Arrow reads the disk by itself far faster than through Python.
        self._is_local = isinstance(filesystem, LocalFileSystem)
        self._arrow = pa.fs.LocalFileSystem() if self._is_local else make_arrow_filesystem(filesystem)

    def record(self) -> dict[str, Any] | None:
        """`run.json`: what it was made with; None where there is none, as in a dataset of another tool.

        Raises:
            InputError: `bad_run` if it does not read, or is no JSON object.
        """
        from tableverse_factory.core.storage.untrusted import (
            MAX_JSON_BYTES,
            parse_json,
        )  # it brings Pillow, which queries need not load

        path = f"{self._root}/run.json"
        try:
            data = self._filesystem.cat_file(path, start=0, end=MAX_JSON_BYTES + 1)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise InputError(str(_unreadable(path, error)), "bad_run") from None
        run = parse_json(data, path, "bad_run")
        if not isinstance(run, dict):
            raise InputError(f"{path} is no record of a build", "bad_run")
        return run

    @cached_property
    def shards(self) -> tuple[int, ...]:
        """Numbers of the committed shards, in order."""
        return tuple(sorted(int(match[1]) for match in map(_SHARD.fullmatch, self._sizes("scenes")) if match))

    @cached_property
    def scenes(self) -> ds.Dataset:
        """A row per scene, also for the dropped and the failed (`schemas.arrow.SCENES`)."""
        return self.table("scenes")

    @cached_property
    def objects(self) -> ds.Dataset:
        """A row per object of the scenes that are done (`schemas.arrow.OBJECTS`)."""
        return self.table("objects")

    @cached_property
    def tasks(self) -> ds.Dataset:
        """A row per task, also for the refused (`schemas.arrow.TASKS`)."""
        return self.table("tasks")

    @cached_property
    def trajectories(self) -> ds.Dataset:
        """A row per task that was tried (`schemas.arrow.TRAJECTORIES`); empty where no trajectories were asked for."""
        return self.table("trajectories")

    def table(self, name: str) -> ds.Dataset:
        """The table of this name as a pyarrow dataset.

        Raises:
            InputError: if there is no such table, or a committed shard lacks its file.
        """
        if name not in TABLES:
            raise InputError(f"no table {name!r}; there are {', '.join(TABLES)}")
        sizes = self._sizes(name)
        names = [f"shard-{shard:05d}.parquet" for shard in self.shards]
        if name in SPARSE:
            names = [shard for shard in names if shard in sizes]
        folder = f"{self._root}/{name}"
        if missing := [name for name in names if name not in sizes]:
            raise InputError(f"{self.path}: damaged: {folder}/{missing[0]} is missing although its shard is committed")
        if not names:
            return ds.dataset(TABLES[name].empty_table())
        merged = f"{self._root}/{MERGED}/{name}.parquet"
        if self._is_made_from(merged, {name: sizes[name] for name in names}):
            return self._files([merged], name)
        return self._files([f"{folder}/{name}" for name in names], name)

    def _sizes(self, table: str) -> dict[str, int]:
        """The files of a table by name, and their sizes [bytes]."""
        folder = f"{self._root}/{table}"
        try:
            entries = self._filesystem.ls(folder, detail=True)
        except (FileNotFoundError, NotADirectoryError):
            return {}
        return {entry["name"].rpartition("/")[2]: int(entry["size"]) for entry in entries if entry["type"] == "file"}

    def _is_made_from(self, merged: str, sizes: Mapping[str, int]) -> bool:
        """Whether there is a merged table, and it holds these shards.

        A damaged one is not needed, but a place that does not answer for one file will not for thousands.
        """
        try:
            metadata = pq.read_metadata(merged, filesystem=self._arrow).metadata or {}
        except StoreError as error:
            raise _unreadable(merged, error) from None
        except (OSError, pa.ArrowException):
            return False
        return bool(metadata.get(MADE_FROM) == digest_shards(sizes))

    def _files(self, paths: Sequence[str], table: str) -> ds.Dataset:
        return ds.dataset(paths, schema=TABLES[table], format="parquet", filesystem=self._arrow)

    def scene(self, scene_id: str) -> "Scene":
        """The scene of this id; reads its own bytes of the shard and nothing else.

        Raises:
            InputError: if there is no such scene, with the nearest ids; if it has no files, with the reason; or if
                the shard is damaged.
        """
        return self.scene_at(self.scene_row(scene_id))

    def scene_row(self, scene_id: str) -> dict[str, Any]:
        """The row of scenes/ of this id, also of a dropped or a failed one; reads its shard's file of the table alone.

        Raises:
            InputError: if there is no such scene, with the nearest ids, or the table does not read.
        """
        shard = self._shard_of.get(scene_id)
        rows = [] if shard is None else self._rows(shard, scene_id, "scenes")
        if not rows:
            raise InputError(self._unknown(scene_id))
        return rows[0]

    def scene_at(self, row: Mapping[str, Any]) -> "Scene":
        """The scene of a row of scenes/ that is known already; reads its own bytes of the shard and nothing else.

        Args:
            row: As the table has it, or its columns `scene_id`, `shard`, `tar_offset` and `tar_size` at least.

        Raises:
            InputError: as `scene`, but for an unknown one.
        """
        scene_id, shard = str(row["scene_id"]), int(row["shard"])
        if row["tar_offset"] is None or row["tar_size"] is None:
            raise InputError(f"scene {scene_id} has no files: {_why_not(row)}")
        rows = partial(self._rows, shard, scene_id)
        return Scene(scene_id, row, read_scene_files(scene_id, self._bytes_of(row, shard)), rows)

    @cached_property
    def _shard_of(self) -> dict[str, int]:
        """The shard of every scene: two columns, read once, so that the thousandth scene opens fast too.

        On the disk of every committed scene; elsewhere of every planned one, because the plan is one small file and a
        table may be a thousand.
        """
        try:
            if not self._is_local and (plan := self._plan()) is not None:
                return plan
            ids, shards = self.scenes.to_table(columns=["scene_id", "shard"]).columns
        except (pa.ArrowException, OSError) as error:
            raise _unreadable(f"{self.path}/scenes", error) from None
        return dict(zip(ids.to_pylist(), shards.to_pylist(), strict=True))

    def _plan(self) -> dict[str, int] | None:
        """The shard of every planned scene; None where there is no plan."""
        try:
            plan = read_remote_table(self._filesystem, f"{self._root}/plan.parquet", PLAN, ("scene_id", "shard"))
        except FileNotFoundError:
            return None
        return dict(zip(*(column.to_pylist() for column in plan.columns), strict=True))

    def _rows(self, shard: int, scene_id: str, table: str) -> list[dict[str, Any]]:
        """The scene's rows in a table's file of one shard; none in that of a shard that is not committed."""
        path = f"{self._root}/{table}/shard-{shard:05d}.parquet"
        mine = pc.field("scene_id") == scene_id
        try:
            if self._is_local:
                found = self._files([path], table).to_table(filter=mine)
            else:
                found = read_remote_table(self._filesystem, path, TABLES[table]).filter(mine)
        except FileNotFoundError:
            if table == "scenes" or table in SPARSE:
                return []
            raise InputError(f"{self.path}: damaged: {path} is missing although its shard is committed") from None
        except (pa.ArrowException, OSError) as error:
            raise _unreadable(path, error) from None
        rows: list[dict[str, Any]] = found.to_pylist()
        return rows

    def _bytes_of(self, row: Mapping[str, Any], shard: int) -> bytes:
        start, size = int(row["tar_offset"]), int(row["tar_size"])
        path = f"{self._root}/mjcf/shard-{shard:05d}.tar"
        if start < 0 or not 0 < size <= MAX_SCENE_BYTES:
            raise InputError(f"{path}: bytes {start} to {start + size} of {row['scene_id']} make no sense")
        try:
            data: bytes = self._filesystem.cat_file(path, start=start, end=start + size)
        except OSError as error:
            raise _unreadable(path, error) from None
        if len(data) != size:
            raise InputError(f"{path}: cut short: {row['scene_id']} has {len(data)} of its {size} bytes")
        return data

    def _unknown(self, scene_id: str) -> str:
        ids = list(self._shard_of)
        if scene_id in self._shard_of:
            return f"scene {scene_id} is planned, and its shard is not committed yet"
        nearest = difflib.get_close_matches(scene_id[:100], ids[:20_000], n=3, cutoff=0.5)
        many = f"{pluralize(len(ids), 'scene')} committed so far, `tableverse query {self.path}` shows them"
        hint = f"nearest: {', '.join(nearest)}" if nearest else many
        return f"no scene {sanitize_line(scene_id, 100)!r}; {hint}"


def _unreadable(path: str, error: Exception) -> InputError:
    if isinstance(error, StoreError):  # it names the file itself
        return InputError(str(error))
    return InputError(f"{path}: does not read: {sanitize_line(str(error), 300)}")


def _why_not(row: Mapping[str, Any]) -> str:
    parts = (row.get("reason") or row.get("error_kind"), row.get("detail"))
    lost = f"{row.get('status')} at {row.get('stage')}: "
    return lost + ": ".join(sanitize_line(part, 500) for part in parts if part)
