"""Datasets as consumers read them: tables as pyarrow datasets, and scenes opened straight from their bytes."""

import difflib
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

from schemas.tables import TABLES
from tableverse_factory.core.errors import InputError, StoreError
from tableverse_factory.core.framing import FrameError
from tableverse_factory.core.storage.files import parse_path, resolve_filesystem
from tableverse_factory.core.storage.parquet import make_arrow_filesystem, read_remote_table
from tableverse_factory.core.text import pluralize, sanitize_line
from tableverse_factory.dataset.consolidated_tables import MADE_FROM, MERGED, digest_shards
from tableverse_factory.dataset.parts import read_part_files
from tableverse_factory.dataset.provisional import NO_OFFSET, ProvisionalScenes, read_provisional
from tableverse_factory.dataset.scene import Scene
from tableverse_factory.dataset.shard_plan import PLAN
from tableverse_factory.dataset.shards import SPARSE, find_shards, shard_name
from tableverse_factory.dataset.tar_members import read_scene_files

__all__ = ["Dataset", "Scene", "open_dataset"]

GALLERY_MARKER = "tableverse-gallery.json"  # file in every gallery; it lists its files, also those still to be drawn
MAX_SCENE_BYTES = 2 * 1024**3


def open_dataset(path: str | Path) -> "Dataset":
    """Open a dataset that `tableverse build` wrote, finished or not; InputError if there is none at `path`.

    It is a folder, `s3://bucket/prefix`, `https://host/folder`, `hf://datasets/OWNER/NAME` (with `@REVISION` for
    another than `main`), or any other fsspec URI.
    """
    try:
        filesystem, root = _filesystem(str(path))
        exists = filesystem.isdir(root)
    except StoreError as error:
        raise InputError(str(error)) from None
    except (OSError, ValueError, ImportError) as error:
        raise InputError(f"{path}: cannot be reached: {sanitize_line(str(error), 300)}") from None
    if not exists:
        kind = "a file" if filesystem.exists(root) else "no such folder"
        raise InputError(f"{path}: {kind}; give the OUT of `tableverse build`")
    if not filesystem.exists(f"{root}/run.json"):
        if filesystem.exists(f"{root}/{GALLERY_MARKER}"):  # it has a folder scenes/ too, of pages
            raise InputError(f"{path}: a gallery; {_suggest_folder(str(path))}")
        if not filesystem.isdir(f"{root}/scenes"):
            raise InputError(f"{path}: neither run.json nor scenes/ in it; {_suggest_folder(str(path))}")
    return Dataset(str(path), filesystem, root)


def _suggest_folder(path: str) -> str:
    """Suggest the folder that was meant: one above, or the only one in it, that holds a build."""
    folder = Path(path)
    meant = [above for above in folder.absolute().parents[:2] if (above / "run.json").is_file()]
    meant += sorted(record.parent for record in folder.glob("*/run.json"))
    return f"did you mean {meant[0]}?" if len(meant) == 1 else "give the OUT of `tableverse build`"


def _filesystem(path: str) -> tuple[fsspec.AbstractFileSystem, str]:
    scheme = path.partition("://")[0]
    if scheme in ("http", "https"):
        from tableverse_factory.dataset.http_dataset import WebFolder, check_web_address

        folder = WebFolder(check_web_address(path))
    elif scheme == "hf":
        from tableverse_factory.dataset.hub_folder import open_hub_folder

        folder = open_hub_folder(path)
    else:
        return resolve_filesystem(path)
    return folder, folder.address


class Dataset:
    """Dataset, finished or growing: committed shards, and scenes that ended in others, if it can list `.work`.

    They are listed once, when a table is first read; open the dataset again to see newer ones.
    """

    def __init__(self, path: str, filesystem: fsspec.AbstractFileSystem, root: str) -> None:
        self.path = path
        self._filesystem = filesystem
        self._root = root.rstrip("/")
        # Arrow reads the disk by itself far faster than through Python.
        self._is_local = isinstance(filesystem, LocalFileSystem)
        is_growing = self._is_local or path.startswith("s3://")  # or may be: other places hold what was published
        self._out = parse_path(path if not self._is_local else self._root) if is_growing else None
        self._arrow = pa.fs.LocalFileSystem() if self._is_local else make_arrow_filesystem(filesystem)

    def record(self) -> dict[str, Any] | None:
        """Read `run.json`; None if there is none, as in a dataset of another tool, InputError `bad_run` if bad."""
        # imports Pillow, which queries need not load
        from tableverse_factory.core.storage.untrusted import MAX_JSON_BYTES, parse_json

        path = f"{self._root}/run.json"
        try:
            data = self._filesystem.cat_file(path, start=0, end=MAX_JSON_BYTES + 1)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise InputError(str(_unreadable_error(path, error)), "bad_run") from None
        run = parse_json(data, path, "bad_run")
        if not isinstance(run, dict):
            raise InputError(f"{path} is no record of a build", "bad_run")
        return run

    @cached_property
    def shards(self) -> tuple[int, ...]:
        """Numbers of the committed shards, in order."""
        if self._provisional is not None:
            return self._provisional.shards
        return tuple(sorted(find_shards(self._list_sizes("scenes"))))

    @cached_property
    def _provisional(self) -> ProvisionalScenes | None:
        """Scenes of shards that are not committed yet; None where they cannot be listed."""
        return None if self._out is None else read_provisional(self._out)

    @cached_property
    def scenes(self) -> ds.Dataset:
        """A row per scene, including dropped and failed ones (`schemas.tables.SCENES`)."""
        return self.table("scenes")

    @cached_property
    def objects(self) -> ds.Dataset:
        """A row per object of the finished scenes (`schemas.tables.OBJECTS`)."""
        return self.table("objects")

    @cached_property
    def tasks(self) -> ds.Dataset:
        """A row per task, including refused ones (`schemas.tables.TASKS`)."""
        return self.table("tasks")

    @cached_property
    def trajectories(self) -> ds.Dataset:
        """A row per task that was tried (`schemas.tables.TRAJECTORIES`); empty in builds without trajectories."""
        return self.table("trajectories")

    def table(self, name: str) -> ds.Dataset:
        """Open a table by name as a pyarrow dataset."""
        if name not in TABLES:
            raise InputError(f"no table {name!r}; there are {', '.join(TABLES)}")
        sizes = self._list_sizes(name)
        names = [file for shard in self.shards if (file := shard_name(name, shard)) in sizes or name not in SPARSE]
        folder = f"{self._root}/{name}"
        if missing := [name for name in names if name not in sizes]:
            raise InputError(f"{self.path}: damaged: {folder}/{missing[0]} is missing although its shard is committed")
        committed = self._open_shards(name, {name: sizes[name] for name in names})
        provisional = None if self._provisional is None else self._provisional.tables[name]
        return ds.dataset([committed, ds.dataset(provisional)]) if provisional else committed

    def _open_shards(self, name: str, sizes: Mapping[str, int]) -> ds.Dataset:
        """Open the committed rows of a table; `sizes` are of its files by name [bytes]."""
        if not sizes:
            return ds.dataset(TABLES[name].empty_table())
        merged = f"{self._root}/{MERGED}/{name}.parquet"
        if self._is_up_to_date(merged, sizes):
            return self._open_files([merged], name)
        return self._open_files([f"{self._root}/{name}/{file}" for file in sizes], name)

    def _list_sizes(self, table: str) -> dict[str, int]:
        """List the sizes of a table's files by name [bytes]."""
        folder = f"{self._root}/{table}"
        try:
            entries = self._filesystem.ls(folder, detail=True)
        except (FileNotFoundError, NotADirectoryError):
            return {}
        return {entry["name"].rpartition("/")[2]: int(entry["size"]) for entry in entries if entry["type"] == "file"}

    def _is_up_to_date(self, merged: str, sizes: Mapping[str, int]) -> bool:
        """Return whether a merged table exists and holds these shards.

        A damaged one is not needed, but a server that does not answer for one file will not for thousands.
        """
        try:
            metadata = pq.read_metadata(merged, filesystem=self._arrow).metadata or {}
        except StoreError as error:
            raise _unreadable_error(merged, error) from None
        except (OSError, pa.ArrowException):
            return False
        return bool(metadata.get(MADE_FROM) == digest_shards(sizes))

    def _open_files(self, paths: Sequence[str], table: str) -> ds.Dataset:
        return ds.dataset(paths, schema=TABLES[table], format="parquet", filesystem=self._arrow)

    def scene(self, scene_id: str) -> "Scene":
        """Open a scene, reading its own bytes and nothing else.

        Raises:
            InputError: if there is no such scene, with the nearest ids; or if it has no files, with the reason.
        """
        return self.scene_at(self.scene_row(scene_id))

    def scene_row(self, scene_id: str) -> dict[str, Any]:
        """Read the scene's row of scenes/; dropped and failed scenes have one too."""
        shard = self._shard_by_scene.get(scene_id)
        rows = [] if shard is None else self._read_rows(shard, scene_id, "scenes")
        if not rows:
            raise InputError(self._describe_unknown(scene_id))
        return rows[0]

    def scene_at(self, row: Mapping[str, Any]) -> "Scene":
        """Open the scene of a row of scenes/, with `scene_id`, `shard`, `tar_offset` and `tar_size` at least."""
        scene_id, shard = str(row["scene_id"]), int(row["shard"])
        if row["tar_offset"] is None or row["tar_size"] is None:
            raise InputError(f"scene {scene_id} has no files: {_describe_loss(row)}")
        data = self._read_part(scene_id) if row["tar_offset"] == NO_OFFSET else self._read_scene_bytes(row, shard)
        if data is None:  # its shard was committed meanwhile
            rows = self._read_committed_rows(shard, scene_id, "scenes")
            if not rows:
                raise InputError(f"scene {scene_id}: its files are gone; the next run of its build makes them again")
            row, data = rows[0], self._read_scene_bytes(rows[0], shard)
        return Scene(scene_id, row, read_scene_files(scene_id, data), partial(self._read_rows, shard, scene_id))

    def _read_part(self, scene_id: str) -> bytes | None:
        """Read the members of a scene that no tar holds yet; None if it has been moved to its shard."""
        if self._out is None or self._provisional is None or scene_id not in self._provisional.parts:
            return None
        shard, part = self._provisional.parts[scene_id]
        try:
            return read_part_files(self._out, shard, part)
        except FileNotFoundError:
            return None
        except FrameError as error:
            raise InputError(f"scene {scene_id}: damaged ({error}); the next run of its build makes it again") from None

    @cached_property
    def _shard_by_scene(self) -> dict[str, int]:
        """The shard of every scene, read once.

        On the disk of every committed scene; elsewhere of every planned one, because the plan is one small file and a
        table may be a thousand.
        """
        try:
            if not self._is_local and (plan := self._read_plan()) is not None:
                return plan
            ids, shards = self.scenes.to_table(columns=["scene_id", "shard"]).columns
        except (pa.ArrowException, OSError) as error:
            raise _unreadable_error(f"{self.path}/scenes", error) from None
        return dict(zip(ids.to_pylist(), shards.to_pylist(), strict=True))

    def _read_plan(self) -> dict[str, int] | None:
        """Read the shard of every planned scene; None if there is no plan."""
        try:
            plan = read_remote_table(self._filesystem, f"{self._root}/plan.parquet", PLAN, ("scene_id", "shard"))
        except FileNotFoundError:
            return None
        return dict(zip(*(column.to_pylist() for column in plan.columns), strict=True))

    def _read_rows(self, shard: int, scene_id: str, table: str) -> list[dict[str, Any]]:
        """Read the scene's rows in a table; none if it has not ended."""
        provisional = None if self._provisional is None else self._provisional.tables[table]
        if provisional and (found := provisional.filter(pc.field("scene_id") == scene_id)):
            return found.to_pylist()
        return self._read_committed_rows(shard, scene_id, table)

    def _read_committed_rows(self, shard: int, scene_id: str, table: str) -> list[dict[str, Any]]:
        """Read the scene's rows from a table's file of one shard; none if the shard is not committed."""
        path = f"{self._root}/{table}/{shard_name(table, shard)}"
        mine = pc.field("scene_id") == scene_id
        try:
            if self._is_local:
                found = self._open_files([path], table).to_table(filter=mine)
            else:
                found = read_remote_table(self._filesystem, path, TABLES[table]).filter(mine)
        except FileNotFoundError:
            if table == "scenes" or table in SPARSE:
                return []
            raise InputError(f"{self.path}: damaged: {path} is missing although its shard is committed") from None
        except (pa.ArrowException, OSError) as error:
            raise _unreadable_error(path, error) from None
        return found.to_pylist()

    def _read_scene_bytes(self, row: Mapping[str, Any], shard: int) -> bytes:
        start, size = int(row["tar_offset"]), int(row["tar_size"])
        path = f"{self._root}/mjcf/{shard_name('mjcf', shard)}"
        if start < 0 or not 0 < size <= MAX_SCENE_BYTES:
            raise InputError(f"{path}: bytes {start} to {start + size} of {row['scene_id']} make no sense")
        try:
            data: bytes = self._filesystem.cat_file(path, start=start, end=start + size)
        except OSError as error:
            raise _unreadable_error(path, error) from None
        if len(data) != size:
            raise InputError(f"{path}: cut short: {row['scene_id']} has {len(data)} of its {size} bytes")
        return data

    def _describe_unknown(self, scene_id: str) -> str:
        ids = list(self._shard_by_scene)
        if scene_id in self._shard_by_scene or scene_id in (self._read_plan() or ()):
            return f"scene {scene_id} is planned and not there yet"
        started = [known for known in ids if scene_id and known.startswith(scene_id)]
        nearest = started[:3] or difflib.get_close_matches(scene_id[:100], ids[:20_000], n=3, cutoff=0.5)
        many = f"{pluralize(len(ids), 'scene')} so far, `tableverse query {self.path}` shows them"
        hint = f"nearest: {', '.join(nearest)}" if nearest else many
        return f"no scene {sanitize_line(scene_id, 100)!r}; {hint}"


def _unreadable_error(path: str, error: Exception) -> InputError:
    if isinstance(error, StoreError):  # it names the file itself
        return InputError(str(error))
    return InputError(f"{path}: does not read: {sanitize_line(str(error), 300)}")


def _describe_loss(row: Mapping[str, Any]) -> str:
    parts = (row.get("reason") or row.get("error_kind"), row.get("detail"))
    lost = f"{row.get('status')} at {row.get('stage')}: "
    return lost + ": ".join(sanitize_line(part, 500) for part in parts if part)
