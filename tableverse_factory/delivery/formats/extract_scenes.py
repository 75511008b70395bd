"""Extraction of many scenes: a folder of each, as the paper's authors published theirs, and an index of the folders."""

import fcntl
import hashlib
import json
import shutil
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import pyarrow.compute as pc

from schemas.identity import check_id
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.core.storage.files import make_write_error, write_atomic
from tableverse_factory.core.storage.untrusted import parse_json
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.dataset.query_parser import parse_filter
from tableverse_factory.dataset.splits import get_split
from tableverse_factory.delivery.formats.extract import MAIN_FILES, check_format, extract_scene
from tableverse_factory.run_record import AFTERWARDS

INDEX, RECORD, STAGING = "index.jsonl", "extract.json", ".partial"
INDEXED = ("parent", "kind", "name", "url", "licence", "n_objects", "usable", "quality_score")
_DIFFERENCES = {"dataset": "of another dataset", "format": "in another format", "appearance": "that look otherwise"}
_PLACE = ("shard", "tar_offset", "tar_size")


@dataclass(frozen=True, slots=True)
class Appearance:
    """Changes of what scenes look like, as of `Scene.restyle`: a texture's name or seed, and seeds."""

    texture: str | int | None = None
    lights: int | None = None
    camera: int | None = None


@dataclass(frozen=True, slots=True)
class ExtractSummary:
    """What an extraction did: scenes written now, scenes that were there, and why others have no folder."""

    written: int
    kept: int
    refused: tuple[tuple[str, str], ...]


@dataclass(frozen=True, slots=True)
class _Job:
    out: str
    dest: str
    row: Mapping[str, Any]
    file_format: str
    appearance: Appearance


def extract_scenes(
    out: str,
    dest: Path,
    file_format: str = "mjcf",
    where: str | None = None,
    appearance: Appearance = Appearance(),
    jobs: int = 1,
    progress: Callable[[int, int], object] = lambda _done, _all: None,
) -> ExtractSummary:
    """Write `DEST/SCENE_ID/` for each finished scene that meets a condition over scenes/, and `DEST/index.jsonl`.

    A folder appears whole. The same call again goes on, and with another condition adds scenes; DEST of another
    dataset, format or appearance is refused.
    """
    check_format(file_format)
    dataset = open_dataset(out)
    record = {"dataset": _identify(dataset), "format": file_format, "appearance": asdict(appearance)}
    condition = pc.scalar(True) if where is None else parse_filter(where, dataset.scenes.schema)
    finished = pc.field("status") == "done"
    columns = ["scene_id", *_PLACE]
    rows = dataset.scenes.to_table(columns=columns, filter=finished & condition).to_pylist()
    if not rows:
        raise InputError(f"{out}: no finished scene" + (f" meets {where!r:.200}" if where else ""), "no_scenes")
    with _claim(dest, record):
        todo = [row for row in rows if not (dest / _check_name(row["scene_id"])).is_dir()]
        kept = len(rows) - len(todo)
        work = [_Job(out, str(dest), row, file_format, appearance) for row in todo]
        refused = []
        for done, (job, why) in enumerate(
            zip(work, parallel_map(_extract_one, work, jobs, "extracts scenes"), strict=True), 1
        ):
            if why:
                refused.append((str(job.row["scene_id"]), why))
            progress(kept + done, len(rows))
        _write_index(dataset, dest, file_format)
    return ExtractSummary(len(todo) - len(refused), kept, tuple(refused))


def _identify(dataset: Dataset) -> str:
    """Identify a dataset by what its build recorded, but for trajectories that were added later."""
    run = {key: value for key, value in (dataset.record() or {}).items() if key != AFTERWARDS}
    return hashlib.sha256(json.dumps(run, sort_keys=True).encode()).hexdigest()


@contextmanager
def _claim(dest: Path, record: Mapping[str, Any]) -> Iterator[None]:
    """Claim a folder for this extraction alone, and remove what a killed one left unfinished."""
    path = dest / RECORD
    known = path.is_file()
    if not known and dest.exists() and (not dest.is_dir() or any(dest.iterdir())):
        raise InputError(f"{dest}: already there; give a new or an empty folder, or one that `extract` began")
    dest.mkdir(parents=True, exist_ok=True)
    if not known:
        write_atomic(path, json.dumps(record, indent=1, sort_keys=True).encode())
    with path.open("rb") as held:
        try:
            fcntl.flock(held, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"{dest}: another extraction writes there") from None
        theirs = parse_json(held.read(), str(path), "bad_record")
        for key, how in _DIFFERENCES.items():
            if not isinstance(theirs, dict) or theirs.get(key) != record[key]:
                raise InputError(f"{dest} holds scenes {how}: give another folder")
        shutil.rmtree(dest / STAGING, ignore_errors=True)
        yield
        shutil.rmtree(dest / STAGING, ignore_errors=True)


def _check_name(scene_id: str) -> str:
    """Check that an id, which a foreign dataset may choose, is the name of a folder."""
    try:
        return check_id(scene_id)
    except ValueError as error:
        raise InputError(f"a scene's id cannot be a folder: {sanitize_line(str(error), 200)}", "bad_name") from None


def _extract_one(job: _Job) -> str:
    """Extract a scene; return why it could not be, or nothing."""
    name, dest = job.row["scene_id"], Path(job.dest)
    staged, look = dest / STAGING / name, job.appearance
    try:
        scene = _open(job.out).scene_at(job.row).restyle(look.texture, look.lights, look.camera)
        extract_scene(scene, staged, job.file_format)
    except InputError as error:
        shutil.rmtree(staged, ignore_errors=True)
        return str(error)
    except OSError as error:
        raise make_write_error(staged, error) from None
    staged.rename(dest / name)
    return ""


@lru_cache(maxsize=1)
def _open(out: str) -> Dataset:
    return open_dataset(out)


def _write_index(dataset: Dataset, dest: Path, file_format: str) -> None:
    """Write a line for each folder, in the order of the dataset."""
    there = {path.name for path in dest.iterdir() if path.is_dir()}
    tasks: dict[str, list[dict[str, str]]] = {}
    asked = dataset.tasks.to_table(columns=["scene_id", "task_id", "instruction"], filter=pc.field("accepted"))
    for row in asked.to_pylist():
        tasks.setdefault(row.pop("scene_id"), []).append(row)
    lines = []
    for batch in dataset.scenes.to_batches(columns=["scene_id", "split", *INDEXED]):
        for row in batch.to_pylist():
            if (name := row["scene_id"]) in there:
                told = {
                    "scene_id": name,
                    "path": f"{name}/{MAIN_FILES[file_format]}",
                    "split": get_split(row),
                }
                told |= {key: row[key] for key in INDEXED} | {"tasks": tasks.get(name, [])}
                lines.append(json.dumps(told, ensure_ascii=True, sort_keys=False))
    write_atomic(dest / INDEX, "".join(f"{line}\n" for line in lines).encode())
