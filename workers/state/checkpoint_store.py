"""Stage outputs kept beside the dataset, so that nothing is computed or paid for twice after a kill.

A checkpoint's name holds the scene, the stage, and a key over everything that the stage and those before it have read,
so one of another configuration is never taken. It is verified when read, and a torn one counts as missing. A tombstone
says that the committed shard holds what it stands for. On the disk each process appends to its own packs (see
`checkpoint_pack`); in a store each checkpoint is an object.
"""

import json
import os
import secrets
from collections import OrderedDict
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from upath import UPath

from schemas.codec import encode
from schemas.config import Config
from schemas.identity import content_hash
from schemas.manifest import ImageRow
from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import (
    StoragePath,
    list_names,
    list_sizes,
    make_write_error,
    read_whole,
    remove,
    remove_folder,
    write_atomic,
)
from tableverse_factory.dataset.shards import shard_stem
from tableverse_factory.stage import Stage
from workers.state.checkpoint_pack import (
    append_checkpoint,
    compact,
    decode_checkpoint,
    encode_checkpoint,
    parse_stage,
    read_packed_checkpoint,
    scan_pack,
)

CHECKPOINTS = ".stages"
TOMBSTONE_PREFIX = b"tableverse-at-rest-1 "  # before the id of a scene that the committed shard holds

_KEY_CHARS = 16
_OPEN_PACKS = 2
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
        names.append(f"{shard_stem(shard)}/{row.scene_id}.{stage}.{key[:_KEY_CHARS]}")
    return (*names[:-1], "")


def name_cost_checkpoint(name: str) -> str:
    """Name the record of what the model requests of a checkpoint cost."""
    return f"{name}-cost"


@dataclass(frozen=True, slots=True)
class CheckpointRef:
    """Where a checkpoint lies."""

    location: str  # argument of `CheckpointStore.read`
    size: int  # stored bytes, compressed


class CheckpointStore:
    """Checkpoints of a build, in a folder that every worker can write, with a folder below it for each shard."""

    def __init__(self, folder: StoragePath) -> None:
        """Nothing is created until something is written."""
        self._folder = folder
        self._packs: OrderedDict[str, int] = OrderedDict()

    def index(self, shard: int) -> dict[str, CheckpointRef]:
        """List the whole checkpoints of a shard by name."""
        stem = shard_stem(shard)
        folder = self._folder / stem
        if isinstance(folder, UPath):
            names = {f"{stem}/{name}": size for name, size in list_sizes(folder).items() if parse_stage(name)}
            return {name: CheckpointRef(name, size) for name, size in names.items()}
        return {
            f"{stem}/{name}": CheckpointRef(f"{stem}/{pack}@{span.start}", span.end - span.start)
            for pack in list_names(folder)
            for name, span in scan_pack(folder / pack)
        }

    def read(self, location: str) -> bytes | None:
        """Read the record at a location of `index`, or of a name; None if it is gone or damaged."""
        record = self._read_stored(location)
        if record is None or not record.startswith(TOMBSTONE_PREFIX):
            return record
        # imports MuJoCo, which few readers need
        from tableverse_factory.dataset.committed_scene import load_exported_scene

        scene_id = record.removeprefix(TOMBSTONE_PREFIX).decode()
        scene = load_exported_scene(self._folder.parent, _parse_shard(location), scene_id)
        return None if scene is None else encode(scene)

    def _read_stored(self, location: str) -> bytes | None:
        folder, _, name = location.rpartition("/")
        pack, at, start = name.partition("@")
        try:
            if isinstance(self._folder, UPath):
                return decode_checkpoint(read_whole(self._folder / folder / name))
            if not at:
                known = self.index(_parse_shard(location)).get(location)
                return None if known is None else self._read_stored(known.location)
            return read_packed_checkpoint(self._folder / folder / pack, int(start))
        except FileNotFoundError:
            return None
        except OSError as error:
            if isinstance(error, BuildError):  # a StoreError, which names the file itself
                raise
            raise BuildError(f"cannot read {self._folder / location}: {error.strerror or error}") from error

    def write(self, name: str, record: bytes) -> None:
        """Write a checkpoint."""
        folder, _, short = name.rpartition("/")
        framed = encode_checkpoint(short, record)
        if isinstance(self._folder, UPath):
            write_atomic(self._folder / folder / short, framed)
            return
        try:
            append_checkpoint(self._open_pack(folder), framed)
        except OSError as error:
            raise make_write_error(self._folder / folder, error) from error

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

    def close(self) -> None:
        """Close the open packs."""
        for descriptor in self._packs.values():
            os.close(descriptor)
        self._packs.clear()

    def _open_pack(self, folder: str) -> int:
        """Open this process's own pack of a shard for appending."""
        known = self._packs.get(folder)
        if known is not None and os.fstat(known).st_nlink == 0:  # its shard was committed and its checkpoints deleted
            os.close(self._packs.pop(folder))
        if folder not in self._packs:
            if len(self._packs) >= _OPEN_PACKS:
                os.close(self._packs.popitem(last=False)[1])
            path = Path(str(self._folder)) / folder / f"{secrets.token_hex(8)}{_PACK}"
            path.parent.mkdir(parents=True, exist_ok=True)
            self._packs[folder] = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        self._packs.move_to_end(folder)
        return self._packs[folder]


def _parse_shard(location: str) -> int:
    return int(location.partition("/")[0].removeprefix("shard-"))
