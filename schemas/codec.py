"""Codec of records without pickle: a tree of JSON beside its arrays, in one Arrow IPC message.

What crosses a process boundary is data, never code: only the record types in `RECORD_TYPES` decode. Equal records give
equal bytes. A stored record is flat: it refers to its parent instead of repeating it, and its large arrays are
addressed by their content, so that each is stored once for all records of a scene.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, is_dataclass
from enum import StrEnum
from hashlib import blake2b
from typing import Any, TypeAlias

import numpy as np
import pyarrow as pa
from pydantic import BaseModel

from schemas import geometry, objects, observation, outcome, scene, trajectories, work
from schemas.curation import Assessment
from schemas.detection import DetectionRecord, Detections
from schemas.known_length import KNOWN_LENGTHS
from schemas.manifest import ImageRow

_MODULES = (geometry, objects, observation, outcome, scene, trajectories, work)

RECORD_TYPES: dict[str, type[Any]] = {  # the dataclasses that flow between stages and processes, and models in them
    kind.__name__: kind
    for kind in (
        *(kind for module in _MODULES for kind in vars(module).values() if isinstance(kind, type)),
        *(Assessment, DetectionRecord, Detections, ImageRow, *KNOWN_LENGTHS),
    )
    if is_dataclass(kind) or issubclass(kind, BaseModel)
}

# Names of the fields of each record, and their default values
_FIELDS = {
    kind: tuple((its.name, its.default) for its in fields(kind)) for kind in RECORD_TYPES.values() if is_dataclass(kind)
}

Blob: TypeAlias = bytes | memoryview | Any  # or a buffer of Arrow, which has no types

_ARRAY_KINDS = "biufc"
_PLAIN = (type(None), bool, int, float, str)
_MIN_SHARED_BYTES = 512  # below this a blob costs less than its digest

_MALFORMED = (
    *(AttributeError, EOFError, IndexError, KeyError, OSError, OverflowError, RecursionError, StopIteration),
    *(TypeError, pa.ArrowException),
)

_SCHEMA = pa.schema([("tree", pa.large_binary()), ("blobs", pa.list_(pa.large_binary()))])


@dataclass(frozen=True, slots=True, eq=False)
class StoredRecord:
    """A record whose message is stored, so that those of later records need not repeat it.

    Attributes:
        name: Under which its message is stored.
        blobs: Large arrays and bytes of its message and of those it refers to, by digest.
    """

    name: str
    record: Any
    blobs: Mapping[str, Blob] = field(default_factory=dict)


def encode(record: Any) -> bytes:
    """Encode a record of `RECORD_TYPES`, or a tuple, mapping or scalar made of them; TypeError for any other type."""
    blobs = _Blobs()
    return _make_message(_to_tree(record, blobs), blobs)


def decode(data: bytes) -> Any:
    """Decode what `encode` gave; ValueError if the bytes are no such message or name an unknown type."""
    try:
        tree, blobs = _read_message(data)
        return _from_tree(tree, blobs.__getitem__)
    except _MALFORMED as error:
        raise _make_error(error) from error


def encode_stored(name: str, record: Any, parent: StoredRecord | None = None) -> tuple[bytes, StoredRecord]:
    """Encode a record to be stored as `name`; what it shares with its parent is referred to."""
    parent = parent or StoredRecord("", None)
    blobs = _SharedBlobs(parent)
    tree = _to_tree(record, blobs)
    head = {"parent": parent.name if blobs.uses_parent else "", "digests": blobs.digests, "record": tree}
    own = {digest: blobs.all[place] for digest, place in blobs.digests.items()}
    known = {**parent.blobs, **own} if blobs.uses_parent else own
    return _make_message(head, blobs), StoredRecord(name, record, known)


def decode_stored(name: str, data: bytes, read_parent: Callable[[str], StoredRecord]) -> StoredRecord:
    """Decode what `encode_stored` gave; `read_parent` reads the record that it refers to."""
    try:
        head, blobs = _read_message(data)
        parent = read_parent(str(head["parent"])) if head["parent"] else StoredRecord("", None)
        known = {**parent.blobs, **{str(digest): blobs[place] for digest, place in head["digests"].items()}}

        def get_blob(place: int | str) -> Blob:
            return known[place] if isinstance(place, str) else blobs[place]

        return StoredRecord(name, _from_tree(head["record"], get_blob, parent.record), known)
    except _MALFORMED as error:
        raise _make_error(error) from error


def normalize(value: Any) -> Any:
    """Return a record as `decode(encode(record))` would, sharing with it what is in that form already.

    So a stage gets the same input, down to the layout of its arrays, from the stage before it and from a checkpoint.
    TypeError for what `encode` refuses.
    """
    if type(value) in _PLAIN or isinstance(value, bytes):
        return value
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, StrEnum):
        return value.value
    if isinstance(value, np.ndarray):
        return _freeze_array(value)
    if isinstance(value, tuple | list):
        items = tuple(normalize(item) for item in value)
        return value if isinstance(value, tuple) and _is_same(items, value) else items
    if isinstance(value, dict):
        entries = {normalize(key): normalize(item) for key, item in value.items()}
        return value if _is_same([*entries, *entries.values()], [*value, *value.values()]) else entries
    kind = _get_kind(value)
    if isinstance(value, BaseModel):
        again = kind.model_validate_json(value.model_dump_json(by_alias=True))
        return value if again == value else again
    given = [getattr(value, name) for name, _ in _FIELDS[kind]]
    parts = [normalize(part) for part in given]
    return value if _is_same(parts, given) else kind(*parts)


def _is_same(new: Sequence[Any], old: Sequence[Any]) -> bool:
    return all(a is b for a, b in zip(new, old, strict=True))


def _freeze_array(array: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
    _check_dtype(array.dtype)
    if type(array) is np.ndarray and array.flags.c_contiguous and not array.flags.writeable:
        return array
    frozen = np.asarray(array, order="C").view()
    frozen.flags.writeable = False
    return frozen


class _Blobs:
    """Arrays and bytes of a message, in the order in which its tree names them."""

    def __init__(self) -> None:
        self.all: list[Blob] = []

    def add(self, blob: bytes | memoryview) -> int | str:
        """Add a blob and return its place."""
        self.all.append(blob)
        return len(self.all) - 1


class _SharedBlobs(_Blobs):
    """Blobs of a stored record: large ones are placed by their digest, each once."""

    def __init__(self, parent: StoredRecord) -> None:
        super().__init__()
        self.parent, self._known = parent.record, parent.blobs
        self.digests: dict[str, int] = {}
        self.uses_parent = False

    def add(self, blob: bytes | memoryview) -> int | str:
        if len(blob) < _MIN_SHARED_BYTES:
            return super().add(blob)
        digest = blake2b(blob, digest_size=16).hexdigest()
        if digest in self._known:
            self.uses_parent = True
        elif digest not in self.digests:
            self.digests[digest] = len(self.all)
            self.all.append(blob)
        return digest


def _make_message(tree: Any, blobs: _Blobs) -> bytes:
    text = json.dumps(tree, separators=(",", ":")).encode()
    batch = pa.record_batch([pa.array([text], pa.large_binary()), _make_list(blobs.all)], _SCHEMA)
    return batch.serialize().to_pybytes()


def _read_message(data: bytes) -> tuple[Any, list[pa.Buffer]]:
    batch = pa.ipc.read_record_batch(pa.py_buffer(data), _SCHEMA)
    batch.validate(full=True)  # offsets of a damaged message would point outside of it
    return json.loads(batch.column(0)[0].as_py()), [blob.as_buffer() for blob in batch.column(1)[0].values or ()]


def _make_error(error: Exception) -> ValueError:
    return ValueError(f"not a message of records: {type(error).__name__}: {error}"[:300])


def _make_list(blobs: Sequence[Blob]) -> pa.ListArray:
    """Make a list of all blobs as one value; appended one by one, Arrow would copy them whenever its buffer grows."""
    ends = np.cumsum([0, *(len(blob) for blob in blobs)], dtype=np.int64)
    buffers = [None, pa.py_buffer(ends), pa.py_buffer(b"".join(blobs))]
    values = pa.Array.from_buffers(pa.large_binary(), len(blobs), buffers)
    return pa.ListArray.from_arrays(pa.array([0, len(blobs)], pa.int32()), values)


def _to_tree(value: Any, blobs: _Blobs) -> Any:
    if type(value) in _PLAIN:
        return value
    if isinstance(blobs, _SharedBlobs) and value is blobs.parent:
        blobs.uses_parent = True
        return {"$parent": True}
    if isinstance(value, bytes):
        return {"$bytes": blobs.add(value)}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, StrEnum):
        return value.value
    if isinstance(value, np.ndarray):
        _check_dtype(value.dtype)
        blob = np.ascontiguousarray(value).reshape(-1).view(np.uint8).data
        return {"$array": blobs.add(blob), "dtype": value.dtype.str, "shape": list(value.shape)}
    if isinstance(value, tuple | list):
        return [_to_tree(item, blobs) for item in value]
    if isinstance(value, dict):
        return {"$dict": [[_to_tree(k, blobs), _to_tree(v, blobs)] for k, v in value.items()]}
    kind = _get_kind(value)
    if isinstance(value, BaseModel):
        return {"$model": kind.__name__, "json": value.model_dump_json(by_alias=True)}
    given = [getattr(value, name) for name, _ in _FIELDS[kind]]
    while given and _is_default(given[-1], _FIELDS[kind][len(given) - 1][1]):
        given.pop()  # the constructor adds it again
    return {"$record": kind.__name__, "fields": [_to_tree(part, blobs) for part in given]}


def _is_default(value: Any, default: Any) -> bool:
    """Whether a value is the default, exactly: 0.0 is not -0.0."""
    same = type(value) is type(default) and value == default
    return same and (type(value) is not float or str(value) == str(default))


def _from_tree(tree: Any, get_blob: Callable[[Any], Blob], parent: Any = None) -> Any:
    if isinstance(tree, list):
        return tuple(_from_tree(item, get_blob, parent) for item in tree)
    if not isinstance(tree, dict):
        return tree
    if "$bytes" in tree:
        return bytes(get_blob(tree["$bytes"]))
    if "$array" in tree:
        dtype = np.dtype(tree["dtype"])
        _check_dtype(dtype)
        return np.frombuffer(get_blob(tree["$array"]), dtype=dtype).reshape(tree["shape"])
    if "$dict" in tree:
        return {_from_tree(k, get_blob, parent): _from_tree(v, get_blob, parent) for k, v in tree["$dict"]}
    if "$parent" in tree:
        return parent
    kind = RECORD_TYPES.get(tree.get("$model") or tree.get("$record") or "")
    if kind is None:
        raise ValueError(f"unknown record type in message: {sorted(tree)[:5]}")
    if "$model" in tree:
        return kind.model_validate_json(tree["json"])
    return kind(*(_from_tree(item, get_blob, parent) for item in tree["fields"]))


def _get_kind(value: Any) -> type[Any]:
    kind = type(value)
    if RECORD_TYPES.get(kind.__name__) is not kind:
        raise TypeError(f"{kind.__qualname__} is no record type (see schemas.codec.RECORD_TYPES)")
    return kind


def _check_dtype(dtype: np.dtype[Any]) -> None:
    if dtype.kind not in _ARRAY_KINDS:
        raise TypeError(f"an array of {dtype} does not travel: give numbers")
