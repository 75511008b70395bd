"""What every stage gave, kept beside the dataset, so that nothing is computed or paid for twice, whatever dies.

A record's name says what it was made from: the scene, the stage, and a key over everything that the stage and those
before it have read. So a record is right wherever it is found, and one that another configuration left is never taken.
A record is written at once by the process that made it, and checked when it is read: one that a kill has torn counts as
none, and costs its computation. It may also say that the committed shard holds what it stands for. On the disk each
process appends to packs of its own (see `record_pack`), in a store each record is an object.
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
    read_whole,
    remove,
    remove_folder,
    write_atomic,
    write_error,
)
from tableverse_factory.stage import Stage
from workers.state.checkpoint_pack import append, compact, frame, frames, stage_of, unpacked, unpacked_at

RECORDS = ".stages"
TOMBSTONE_PREFIX = b"tableverse-at-rest-1 "
"""A record that begins so stands for what the committed shard holds of the scene whose id follows."""

_KEY_CHARS = 16
_OPEN_PACKS = 2
_PACK = ".pack"


def stage_fingerprints(line: Sequence[Stage], config: Config, recorded: Mapping[str, object]) -> dict[str, str]:
    """A hash per stage over everything that decides its answer besides its input.

    Args:
        line: The stages.
        config: Of the build.
        recorded: What stages read besides their input and the configuration, by stage.
    """
    return {
        stage.name: content_hash(
            json.dumps([config.run.seed, stage.name, stage.values(config), recorded.get(stage.name)]).encode()
        )
        for stage in line
    }


def record_names(shard: int, row: ImageRow, fingerprints: Mapping[str, str]) -> tuple[str, ...]:
    """Names of what each stage of a line gives for a row; empty for the last, whose output is the scene's result.

    Args:
        shard: Where the scene stands.
        row: Of the manifest.
        fingerprints: Of the line's stages, in order.
    """
    key = content_hash(row.model_dump_json().encode())
    names = []
    for stage, fingerprint in fingerprints.items():
        key = content_hash(key.encode(), fingerprint.encode())
        names.append(f"{_folder(shard)}/{row.scene_id}.{stage}.{key[:_KEY_CHARS]}")
    return (*names[:-1], "")


def cost_record(name: str) -> str:
    """Name of the record of what the questions cost that were asked for the record of this name."""
    return f"{name}-cost"


@dataclass(frozen=True, slots=True)
class CheckpointRef:
    """Where a record lies.

    Attributes:
        place: What `Records.read` takes.
        size: Bytes that it takes there, compressed.
    """

    place: str
    size: int


class CheckpointStore:
    """The records of a build, in a folder that every worker can write; a folder below it for each shard."""

    def __init__(self, folder: StoragePath) -> None:
        """Nothing is made until something is written."""
        self._folder = folder
        self._packs: OrderedDict[str, int] = OrderedDict()

    def index(self, shard: int) -> dict[str, CheckpointRef]:
        """All records of a shard, by name; what is torn is left out."""
        folder = self._folder / _folder(shard)
        if isinstance(folder, UPath):
            objects = {f"{_folder(shard)}/{name}": size for name, size in list_sizes(folder).items() if stage_of(name)}
            return {name: CheckpointRef(name, size) for name, size in objects.items()}
        found: dict[str, CheckpointRef] = {}
        for pack in list_names(folder):
            for name, offset, size in frames(folder / pack):
                found[f"{_folder(shard)}/{name}"] = CheckpointRef(f"{_folder(shard)}/{pack}@{offset}", size)
        return found

    def read(self, place: str) -> bytes | None:
        """The record at a place of `index`, or of a name; None where it is gone or damaged.

        Raises:
            BuildError: if the disk or the store refuses, or the committed shard is damaged that holds it.
        """
        record = self._stored(place)
        if record is None or not record.startswith(TOMBSTONE_PREFIX):
            return record
        from tableverse_factory.dataset.committed_scene import (
            load_exported_scene,  # it brings MuJoCo, which few readers need
        )

        scene_id = record.removeprefix(TOMBSTONE_PREFIX).decode()
        scene = load_exported_scene(self._folder.parent, _shard_of(place), scene_id)
        return None if scene is None else encode(scene)

    def _stored(self, place: str) -> bytes | None:
        folder, _, name = place.rpartition("/")
        pack, at, offset = name.partition("@")
        try:
            if isinstance(self._folder, UPath):
                return unpacked(read_whole(self._folder / folder / name))
            if not at:
                known = self.index(_shard_of(place)).get(place)
                return None if known is None else self._stored(known.place)
            return unpacked_at(self._folder / folder / pack, int(offset))
        except FileNotFoundError:
            return None
        except OSError as error:
            if isinstance(error, BuildError):  # a store says what is the matter itself
                raise
            raise BuildError(f"cannot read {self._folder / place}: {error.strerror or error}") from error

    def write(self, name: str, record: bytes) -> None:
        """Keeps a record.

        Raises:
            BuildError: if the disk is full or refuses.
        """
        folder, _, short = name.rpartition("/")
        framed = frame(short, record)
        if isinstance(self._folder, UPath):
            write_atomic(self._folder / folder / short, framed)
            return
        try:
            append(self._pack(folder), framed)
        except OSError as error:
            raise write_error(self._folder / folder, error) from error

    def forget(self, shard: int, stages: Collection[str] | None = None) -> None:
        """Removes the records of a shard, or those of some stages of it.

        Raises:
            BuildError: if the disk refuses.
        """
        folder = self._folder / _folder(shard)
        if stages is None:
            remove_folder(folder)
            return
        for name in list_names(folder):
            if isinstance(folder, UPath):
                if stage_of(name) in stages:
                    remove(folder / name)
            else:
                compact(folder / name, stages)

    def close(self) -> None:
        """Closes what is open."""
        for descriptor in self._packs.values():
            os.close(descriptor)
        self._packs.clear()

    def _pack(self, folder: str) -> int:
        """This process's own pack of a shard, open for appending."""
        known = self._packs.get(folder)
        if known is not None and os.fstat(known).st_nlink == 0:  # its shard was committed, and the records forgotten
            os.close(self._packs.pop(folder))
        if folder not in self._packs:
            if len(self._packs) >= _OPEN_PACKS:
                os.close(self._packs.popitem(last=False)[1])
            path = Path(str(self._folder)) / folder / f"{secrets.token_hex(8)}{_PACK}"
            path.parent.mkdir(parents=True, exist_ok=True)
            self._packs[folder] = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o644)
        self._packs.move_to_end(folder)
        return self._packs[folder]


def _folder(shard: int) -> str:
    return f"shard-{shard:05d}"


def _shard_of(place: str) -> int:
    return int(place.partition("/")[0].removeprefix("shard-"))
