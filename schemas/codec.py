"""Codec of records without pickle: a tree of JSON beside its arrays, in one Arrow IPC message.

What crosses a process boundary is data, never code: only the record types in `RECORD_TYPES` decode. Equal records give
equal bytes.
"""

import json
from dataclasses import fields, is_dataclass
from enum import StrEnum
from typing import Any

import numpy as np
import pyarrow as pa
from pydantic import BaseModel

from schemas import geometry, objects, observation, outcome, scene, trajectories, work
from schemas.curation import Assessment
from schemas.detection import DetectionRecord, Detections
from schemas.manifest import ImageRow

_MODULES = (geometry, objects, observation, outcome, scene, trajectories, work)

RECORD_TYPES: dict[str, type[Any]] = {  # the dataclasses that flow between stages and processes, and models in them
    kind.__name__: kind
    for kind in (
        *(kind for module in _MODULES for kind in vars(module).values() if isinstance(kind, type)),
        *(Assessment, DetectionRecord, Detections, ImageRow),
    )
    if is_dataclass(kind) or issubclass(kind, BaseModel)
}

_ARRAY_KINDS = "biufc"

_MALFORMED = (
    *(AttributeError, EOFError, IndexError, KeyError, OSError, OverflowError, RecursionError, StopIteration),
    *(TypeError, pa.ArrowException),
)

_SCHEMA = pa.schema([("tree", pa.large_binary()), ("blobs", pa.list_(pa.large_binary()))])


def encode(record: Any) -> bytes:
    """Encode a record of `RECORD_TYPES`, or a tuple, mapping or scalar made of them; TypeError for any other type."""
    blobs: list[bytes | memoryview] = []
    tree = json.dumps(_to_tree(record, blobs), separators=(",", ":")).encode()
    batch = pa.record_batch([pa.array([tree], pa.large_binary()), _make_list(blobs)], _SCHEMA)
    return batch.serialize().to_pybytes()


def decode(data: bytes) -> Any:
    """Decode what `encode` gave; ValueError if the bytes are no such message or name an unknown type."""
    try:
        batch = pa.ipc.read_record_batch(pa.py_buffer(data), _SCHEMA)
        batch.validate(full=True)  # offsets of a damaged message would point outside of it
        blobs = [blob.as_buffer() for blob in batch.column(1)[0].values or ()]
        return _from_tree(json.loads(batch.column(0)[0].as_py()), blobs)
    except _MALFORMED as error:
        raise ValueError(f"not a message of records: {type(error).__name__}: {error}"[:300]) from error


def _make_list(blobs: list[bytes | memoryview]) -> pa.ListArray:
    """Make a list of all blobs as one value; appended one by one, Arrow would copy them whenever its buffer grows."""
    ends = np.cumsum([0, *(len(blob) for blob in blobs)], dtype=np.int64)
    buffers = [None, pa.py_buffer(ends), pa.py_buffer(b"".join(blobs))]
    values = pa.Array.from_buffers(pa.large_binary(), len(blobs), buffers)
    return pa.ListArray.from_arrays(pa.array([0, len(blobs)], pa.int32()), values)


def _to_tree(value: Any, blobs: list[bytes | memoryview]) -> Any:
    if type(value) in (type(None), bool, int, float, str):
        return value
    if isinstance(value, bytes):
        blobs.append(value)
        return {"$bytes": len(blobs) - 1}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, StrEnum):
        return value.value
    if isinstance(value, np.ndarray):
        if value.dtype.kind not in _ARRAY_KINDS:
            raise TypeError(f"an array of {value.dtype} does not travel: give numbers")
        blobs.append(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
        return {"$array": len(blobs) - 1, "dtype": value.dtype.str, "shape": list(value.shape)}
    if isinstance(value, tuple | list):
        return [_to_tree(item, blobs) for item in value]
    if isinstance(value, dict):
        return {"$dict": [[_to_tree(k, blobs), _to_tree(v, blobs)] for k, v in value.items()]}
    name = type(value).__name__
    if RECORD_TYPES.get(name) is not type(value):
        raise TypeError(f"{type(value).__qualname__} is no record type (see schemas.codec.RECORD_TYPES)")
    if isinstance(value, BaseModel):
        return {"$model": name, "json": value.model_dump_json(by_alias=True)}
    return {"$record": name, "fields": [_to_tree(getattr(value, f.name), blobs) for f in fields(value)]}


def _from_tree(tree: Any, blobs: list[pa.Buffer]) -> Any:
    if isinstance(tree, list):
        return tuple(_from_tree(item, blobs) for item in tree)
    if not isinstance(tree, dict):
        return tree
    if "$bytes" in tree:
        return blobs[tree["$bytes"]].to_pybytes()
    if "$array" in tree:
        dtype = np.dtype(tree["dtype"])
        if dtype.kind not in _ARRAY_KINDS:
            raise ValueError(f"an array of {dtype} does not travel")
        return np.frombuffer(blobs[tree["$array"]], dtype=dtype).reshape(tree["shape"])
    if "$dict" in tree:
        return {_from_tree(k, blobs): _from_tree(v, blobs) for k, v in tree["$dict"]}
    kind = RECORD_TYPES.get(tree.get("$model") or tree.get("$record") or "")
    if kind is None:
        raise ValueError(f"unknown record type in message: {sorted(tree)[:5]}")
    if "$model" in tree:
        return kind.model_validate_json(tree["json"])
    return kind(*(_from_tree(item, blobs) for item in tree["fields"]))
