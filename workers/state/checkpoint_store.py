"""Stage outputs kept beside the dataset, so that nothing is computed or paid for twice after a kill.

A checkpoint's name holds the scene, the stage, and a key over everything that the stage and those before it have read,
so one of another configuration is never taken. It is verified when read, and a torn one counts as missing. A tombstone
says that the committed shard holds what it stands for. A checkpoint refers to the one before it for what both hold; if
that is gone, it counts as missing too. On the disk each process appends to its own packs (see `checkpoint_pack`); in a
store each checkpoint is an object.
"""

import json
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from upath import UPath

from schemas.codec import StoredRecord, decode_stored, encode_stored
from schemas.config import Config
from schemas.identity import content_hash
from schemas.manifest import ImageRow
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.append_files import AppendFiles
from tableverse_factory.core.storage.files import (
    StoragePath,
    list_names,
    list_sizes,
    read_whole,
    remove,
    remove_folder,
    write_atomic,
)
from tableverse_factory.dataset.shards import shard_stem
from tableverse_factory.stage import Stage
from workers.state.checkpoint_pack import (
    compact,
    decode_checkpoint,
    encode_checkpoint,
    parse_stage,
    read_packed_checkpoint,
    scan_pack,
)

CHECKPOINTS = ".stages"

_KEY_CHARS = 16
_MAX_PARENTS = 100
_PACK = ".pack"


def fingerprint_stages(stages: Sequence[Stage], config: Config, recorded: Mapping[str, object]) -> dict[str, str]:
    """Hash what decides each stage's output besides its input: the configuration, and what is `recorded` for it."""
    return {
        stage.name: content_hash(
            json.dumps([config.run.seed, stage.name, stage.select_values(config), recorded.get(stage.name)]).encode()
        )
        for stage in stages
    }


def name_checkpoints(shard: int, row: ImageRow, fingerprints: Mapping[str, str]) -> tuple[str, ...]:
    """Name the checkpoint of each stage for a row; empty for the last, whose output is the scene's result."""
    key = content_hash(row.model_dump_json().encode())
    names = []
    for stage, fingerprint in fingerprints.items():
        key = content_hash(key.encode(), fingerprint.encode())
        names.append(name_checkpoint(shard, row.scene_id, stage, key[:_KEY_CHARS]))
    return (*names[:-1], "")


def name_checkpoint(shard: int, scene_id: str, stage: str, key: str) -> str:
    """Name the checkpoint of a stage's output."""
    return f"{shard_stem(shard)}/{scene_id}.{stage}.{key}"


def parse_key(name: str) -> str:
    """Parse the key of a checkpoint's name; empty for an empty one."""
    return name.rpartition(".")[2]


def name_cost_checkpoint(name: str) -> str:
    """Name the record of what the model requests of a checkpoint cost."""
    return f"{name}-cost"


@dataclass(frozen=True, slots=True)
class CheckpointRef:
    """Where a checkpoint lies."""

    location: str  # its name; on the disk followed by `@`, its pack, `@`, and where it begins there
    size: int  # stored bytes, compressed


class CheckpointStore:
    """Checkpoints of a build, in a folder that every worker can write, with a folder below it for each shard."""

    def __init__(self, folder: StoragePath) -> None:
        """Nothing is created until something is written."""
        self._folder, self._packs = folder, AppendFiles(_PACK)
        self._indexed: tuple[int, Mapping[str, CheckpointRef]] = (-1, {})  # a shard, as last read from the disk

    def index(self, shard: int) -> dict[str, CheckpointRef]:
        """List the whole checkpoints of a shard by name."""
        stem = shard_stem(shard)
        folder = self._folder / stem
        if isinstance(folder, UPath):
            names = {f"{stem}/{name}": size for name, size in list_sizes(folder).items() if parse_stage(name)}
            return {name: CheckpointRef(name, size) for name, size in names.items()}
        return {
            f"{stem}/{name}": CheckpointRef(f"{stem}/{name}@{pack}@{span.start}", span.end - span.start)
            for pack in list_names(folder)
            for name, span in scan_pack(folder / pack)
        }

    def read(self, location: str) -> StoredRecord | None:
        """Read the record at a location of `index`, or of a name; None if it is gone or damaged, or its parents are."""
        try:
            return self._read_with_parents(location, _MAX_PARENTS)
        except (_MissingError, ValueError):
            return None

    def write(self, name: str, record: Any, parent: StoredRecord | None = None) -> StoredRecord:
        """Write a record, which need not hold what that of its parent does; its name then is its location.

        A tombstone is a scene's id alone.
        """
        folder, _, short = name.rpartition("/")
        message, stored = encode_stored(name, record, parent)
        framed = encode_checkpoint(short, message)
        if isinstance(self._folder, UPath):
            write_atomic(self._folder / folder / short, framed)
            return stored
        pack, start = self._packs.append(Path(str(self._folder), folder), framed)
        return replace(stored, name=f"{name}@{pack}@{start}")

    def delete(self, shard: int, stages: Collection[str] | None = None) -> None:
        """Delete the checkpoints of a shard, or of some of its stages."""
        folder = self._folder / shard_stem(shard)
        if stages is None:
            remove_folder(folder)
            return
        for name in list_names(folder):
            if not isinstance(folder, UPath):
                compact(folder / name, stages)
            elif parse_stage(name) in stages:
                remove(folder / name)

    def _read_with_parents(self, location: str, left: int) -> StoredRecord:
        """Read a record; `left` bounds the parents of damaged checkpoints, which could refer to each other."""
        message = self._read_message(location)
        if message is None or left == 0:
            raise _MissingError
        stored = decode_stored(location, message, lambda parent: self._read_with_parents(parent, left - 1))
        if not isinstance(stored.record, str):
            return stored
        # imports MuJoCo, which few readers need
        from tableverse_factory.dataset.committed_scene import load_exported_scene

        scene = load_exported_scene(self._folder.parent, _parse_shard(location), stored.record)
        if scene is None:
            raise _MissingError
        return StoredRecord(stored.name, scene)

    def _read_message(self, location: str) -> bytes | None:
        name, _, place = location.partition("@")
        folder, _, short = name.rpartition("/")
        try:
            if isinstance(self._folder, UPath):
                found = decode_checkpoint(read_whole(self._folder / folder / short))
            else:
                found = self._read_packed(folder, place) if place else None
                if found is None or found[0] != short:  # known by name alone, or its pack was compacted since
                    found = self._read_packed(folder, self._find_place(name))
        except FileNotFoundError:
            return None
        except OSError as error:
            if isinstance(error, BuildError):  # a StoreError, which names the file itself
                raise
            raise BuildError(f"cannot read {self._folder / name}: {error.strerror or error}") from error
        return None if found is None else found[1]

    def _read_packed(self, folder: str, place: str) -> tuple[str, bytes] | None:
        pack, _, start = place.partition("@")
        try:
            return read_packed_checkpoint(Path(str(self._folder), folder, pack), int(start))
        except FileNotFoundError:
            return None

    def _find_place(self, name: str) -> str:
        """Find a checkpoint on the disk by its name; packs are scanned again only for names that are not known."""
        shard = _parse_shard(name)
        if self._indexed[0] != shard or name not in self._indexed[1]:
            self._indexed = shard, self.index(shard)
        if name not in self._indexed[1]:
            raise FileNotFoundError(name)
        return self._indexed[1][name].location.partition("@")[2]


class _MissingError(Exception):
    """A checkpoint that is gone or damaged."""


def _parse_shard(location: str) -> int:
    return int(location.partition("/")[0].removeprefix("shard-"))
