"""Photographs, masks and words of all scenes as one table with image columns, for the package `datasets` and the Hub.

Its card leads `load_dataset` to data/SPLIT-00000.parquet and further files, with a row per scene made from a picture.
"""

import json
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import yaml

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.text import pluralize, sanitize_line
from tableverse_factory.dataset.card_yaml import make_license_keys, name_size
from tableverse_factory.dataset.dataset import Dataset, Scene
from tableverse_factory.dataset.preview_image import PHOTOGRAPH
from tableverse_factory.dataset.scene_meta import read_object_names
from tableverse_factory.dataset.splits import SPLITS, get_split

MASKS = "observation/masks.png"
_MAX_FILE_BYTES = 400 * 1024**2  # before a new file begins
_ROW_GROUP = 32  # rows, which readers load together
_TEXTS = ("scene_id", "name", "source", "licence")
_IMAGE = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
_FIELDS = [
    *((name, pa.string()) for name in _TEXTS),
    ("quality_score", pa.int32()),
    ("labels", pa.list_(pa.string())),
    ("mask_values", pa.list_(pa.int32())),  # of each of `labels`; null where the mask has none
    ("instructions", pa.list_(pa.string())),
    ("photograph", _IMAGE),
    ("masks", _IMAGE),
]


def export_pictures(dataset: Dataset, dest: Path, progress: Callable[[int, int], None] | None = None) -> dict[str, int]:
    """Write the table into a new folder, which appears when it is complete; return the rows of each split.

    The same dataset gives the same bytes. `progress` is called with the number of scenes read and of all.
    """
    if dest.exists() or dest.is_symlink():
        raise InputError(f"{dest}: already there; give a new name", "dest_exists")
    rows = dataset.scenes.to_table(filter=pc.field("status") == "done").sort_by("scene_id").to_pylist()
    dest = dest.absolute()
    dest.parent.mkdir(parents=True, exist_ok=True)
    counts, licences = Counter[str](), Counter[str]()
    with tempfile.TemporaryDirectory(prefix=f".{dest.name}-", dir=dest.parent) as scratch:
        folder = Path(scratch) / "pictures"
        writers = {split: _SplitWriter(folder / "data", split) for split in SPLITS}
        for number, row in enumerate(rows, 1):
            made = _build_row(dataset.scene_at(row))
            if made is not None:
                split = get_split(row)
                writers[split].add(made)
                counts[split] += 1
                licences[row["licence"] or ""] += 1
            if progress is not None:
                progress(number, len(rows))
        for writer in writers.values():
            writer.close()
        if not counts:
            raise InputError(f"{dataset.path}: no finished scene was made from a picture")
        kept = {split: counts[split] for split in SPLITS if counts[split]}
        (folder / "README.md").write_text(_make_card(kept, licences), encoding="utf-8")
        folder.rename(dest)
    return kept


def _build_row(scene: Scene) -> dict[str, Any] | None:
    """Build a scene's row; None if it was not made from a picture."""
    files = scene.files()
    if PHOTOGRAPH not in files:
        return None
    tasks = [row["instruction"] for row in scene.task_rows() if row["accepted"]]
    meta = scene.meta
    names, values = read_object_names(meta), _read_mask_values(meta)
    masks = {"bytes": files[MASKS], "path": "masks.png"} if MASKS in files else None
    return {
        **{name: sanitize_line(str(scene.row[name] or ""), 300) for name in _TEXTS},
        "quality_score": scene.row["quality_score"],
        "labels": list(names.values()),
        "mask_values": [values[name] for name in names],
        "instructions": [sanitize_line(str(text), 500) for text in tasks],
        "photograph": {"bytes": files[PHOTOGRAPH], "path": "color.jpg"},
        "masks": masks,
    }


def _read_mask_values(meta: Mapping[str, Any]) -> dict[str, int | None]:
    """Read the pixel value of every object in its scene's masks, which 16 bits bound."""
    values = {str(item["object_id"]): item.get("mask_value") for item in meta["objects"]}
    return {name: value if isinstance(value, int) and 0 < value < 2**16 else None for name, value in values.items()}


class _SplitWriter:
    """Files of one split, begun with its first row."""

    def __init__(self, folder: Path, split: str) -> None:
        self._folder, self._split = folder, split
        self._rows: list[dict[str, Any]] = []
        self._writer: pq.ParquetWriter | None = None
        self._files = self._bytes = 0

    def add(self, row: dict[str, Any]) -> None:
        """Add a row; a file that is large enough is closed."""
        self._rows.append(row)
        self._bytes += sum(len(row[name]["bytes"]) for name in ("photograph", "masks") if row[name])
        if len(self._rows) == _ROW_GROUP or self._bytes >= _MAX_FILE_BYTES:
            self._flush()
        if self._bytes >= _MAX_FILE_BYTES:
            self.close()

    def _flush(self) -> None:
        if not self._rows:
            return
        if self._writer is None:
            self._folder.mkdir(parents=True, exist_ok=True)
            path = self._folder / f"{self._split}-{self._files:05d}.parquet"
            self._writer = pq.ParquetWriter(path, _make_schema(), compression="snappy")
        self._writer.write_table(pa.Table.from_pylist(self._rows, schema=_make_schema()))
        self._rows = []

    def close(self) -> None:
        """Write what waits, and complete the file."""
        self._flush()
        if self._writer is not None:
            self._writer.close()
            self._writer, self._files, self._bytes = None, self._files + 1, 0


def _make_schema() -> pa.Schema:
    """Make the schema, with the features by which `datasets` decodes the pictures."""
    features = {name: _describe_feature(kind) for name, kind in _FIELDS}
    return pa.schema(_FIELDS, metadata={"huggingface": json.dumps({"info": {"features": features}})})


def _describe_feature(kind: pa.DataType) -> dict[str, Any]:
    if kind == _IMAGE:
        return {"_type": "Image"}
    if pa.types.is_list(kind):
        return {"feature": {"dtype": str(kind.value_type), "_type": "Value"}, "_type": "Sequence"}
    return {"dtype": str(kind), "_type": "Value"}


def _make_card(counts: dict[str, int], licences: Counter[str]) -> str:
    head = {
        "pretty_name": "Photographs of table-tops with masks and instructions",
        **make_license_keys(licences),
        "size_categories": [name_size(sum(counts.values()))],
        "task_categories": ["image-segmentation", "robotics"],
        "configs": [
            {
                "config_name": "default",
                "data_files": [{"split": split, "path": f"data/{split}-*.parquet"} for split in counts],
            }
        ],
    }
    named = ", ".join(f"{sanitize_line(name, 60) or 'not stated'} {count}" for name, count in sorted(licences.items()))
    parts = [
        f"---\n{yaml.safe_dump(head, sort_keys=False)}---",
        "# Photographs of table-tops with masks and instructions",
        f"{pluralize(sum(counts.values()), 'scene')} of TableVerse Factory. `mask_values` are the pixels of `masks` "
        "that show each of `labels`; the certified scenes themselves are found by `scene_id`.",
        f"Licences: {named}.",
    ]
    return "\n\n".join(parts) + "\n"
