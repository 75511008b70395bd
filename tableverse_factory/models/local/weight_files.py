"""Weights in the Hub's cache on this machine: where a model's files lie, and whether they are whole.

The cache is that of huggingface_hub (`HF_HUB_CACHE`, else `$HF_HOME/hub`), so that every loader finds the files.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from schemas.config import Config
from tableverse_factory.core.errors import WeightsError
from tableverse_factory.core.file_hash import hash_file
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.core.storage.files import write_atomic
from tableverse_factory.core.text import describe_error
from tableverse_factory.models.local.catalogue import BY_REPOSITORY, DEFAULT_WEIGHTS, ModelEntry, WeightFile
from tableverse_factory.models.local.hf_weights import GIT_HASH, parse_hub_name

LOCK_NAME = "tableverse.lock.json"  # in a repository's folder of the cache: what was fetched, by commit and file
LOCK_FORMAT = "tableverse-weights-1"
SHA256 = re.compile(r"[0-9a-f]{64}")

State = Literal["present", "missing", "damaged", "elsewhere"]
_MAX_LOCK_BYTES = 1 << 20


@dataclass(frozen=True, slots=True)
class FileState:
    """State of a file; `detail` is what is wrong, or what it was held to; `sha256` is empty if it was not computed."""

    name: str
    state: State
    detail: str = ""
    sha256: str = ""


@dataclass(frozen=True, slots=True)
class ModelState:
    """State of a model on this machine, with its folder if it is there; `elsewhere` is the care of other programs."""

    name: str
    state: State
    folder: str
    files: tuple[FileState, ...]


def find_models(config: Config) -> tuple[tuple[ModelEntry, ...], tuple[str, ...]]:
    """Find the models that a configuration loads, and the weights that it names which the catalogue does not hold.

    Another commit than the catalogue's has other files: their sizes and hashes are unknown.
    """
    named = (
        (config.observe.depth, config.observe.depth_weights),
        (config.perceive.detector, config.perceive.detector_weights),
        (config.perceive.segmenter, config.perceive.segmenter_weights),
        (config.place.mesh_model, ""),
    )
    models, others = [], []
    for backend, weights in named:
        if backend not in DEFAULT_WEIGHTS:
            continue  # of the factory itself, or behind an address
        hub = parse_hub_name(weights or DEFAULT_WEIGHTS[backend])
        if hub is None or hub.name not in BY_REPOSITORY:
            others.append(weights)
            continue
        model = BY_REPOSITORY[hub.name]
        if hub.revision != model.revision:
            files = tuple(WeightFile(file.name) for file in model.files)
            model = replace(model, revision=hub.revision, files=files)
        models.append(model)
    return tuple(models), tuple(others)


def locate_repository(model: ModelEntry) -> Path:
    """Locate the folder of a repository in the cache, which need not exist."""
    constants: Any = import_extra("huggingface_hub.constants", "looking for weights", "models")
    return Path(constants.HF_HUB_CACHE) / f"models--{model.repository.replace('/', '--')}"


def find_commit(model: ModelEntry) -> str:
    """Find the commit that a model's revision means on this machine; empty if the cache does not know it."""
    if GIT_HASH.fullmatch(model.revision):
        return model.revision
    path = locate_repository(model) / "refs" / (model.revision or "main")
    commit = path.read_text().strip() if path.is_file() else ""
    return commit if GIT_HASH.fullmatch(commit) else ""


def locate_file(model: ModelEntry, commit: str, name: str) -> Path:
    """Locate a file of a commit in the cache; it need not exist."""
    return locate_repository(model) / "snapshots" / commit / name


def check_model(model: ModelEntry) -> ModelState:
    """Check the files of a model against the catalogue, the lock, or the hash that the cache names them by."""
    if not model.files:
        return ModelState(model.name, "elsewhere", "", ())
    commit = find_commit(model)
    lock = read_lock(model).get(commit, {})
    files = tuple(check_file(model, commit, file, lock.get(file.name)) for file in model.files)
    states = {file.state for file in files}
    state: State = "damaged" if "damaged" in states else "missing" if "missing" in states else "present"
    folder = "" if state == "missing" else str(locate_file(model, commit, "").parent)
    return ModelState(model.name, state, folder, files)


def check_file(model: ModelEntry, commit: str, file: WeightFile, locked: WeightFile | None) -> FileState:
    """Check a file at a commit."""
    path = locate_file(model, commit, file.name)
    if not commit or not path.is_file():
        return FileState(file.name, "missing")
    size, sizes = path.stat().st_size, [wanted.size for wanted in (file, locked) if wanted and wanted.size is not None]
    if wrong := [wanted for wanted in sizes if wanted != size]:
        return FileState(file.name, "damaged", f"{size} bytes, not {wrong[0]}")
    wanted = file.sha256 or (locked.sha256 if locked else "")
    named = "" if wanted else path.resolve().name
    if SHA256.fullmatch(wanted or named):
        found = hash_file(path)
        origin = "the catalogue" if file.sha256 else "the lock" if wanted else "its name in the cache"
        if found != (wanted or named):
            return FileState(file.name, "damaged", f"sha256 {found}, not {wanted or named}")
        return FileState(file.name, "present", f"sha256 of {origin}", found)
    if GIT_HASH.fullmatch(named):
        if hash_git_blob(path) != named:
            return FileState(file.name, "damaged", f"not the blob {named} of git")
        return FileState(file.name, "present", "git's hash, its name in the cache")
    return FileState(file.name, "present", "no hash is known: fetch it once to record one")


def hash_git_blob(path: Path) -> str:
    """Compute the hash by which git, and the Hub for small files, names a file."""
    digest = hashlib.sha1(f"blob {path.stat().st_size}\0".encode(), usedforsecurity=False)
    with path.open("rb") as file:
        return hashlib.file_digest(file, lambda: digest).hexdigest()


def read_lock(model: ModelEntry) -> dict[str, dict[str, WeightFile]]:
    """Read the sizes and hashes that were recorded when files were fetched, by commit and name; empty without a lock.

    Raises:
        WeightsError: if the lock cannot be read.
    """
    path = locate_repository(model) / LOCK_NAME
    if not path.exists():
        return {}
    try:
        if path.stat().st_size > _MAX_LOCK_BYTES:
            raise ValueError("it is too large")
        tree = json.loads(path.read_bytes())
        if tree["format"] != LOCK_FORMAT:
            raise ValueError(f"its format is not {LOCK_FORMAT}")
        return {
            commit: {name: WeightFile(name, int(own["size"]), str(own["sha256"])) for name, own in files.items()}
            for commit, files in tree["commits"].items()
        }
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise WeightsError(
            f"{path} cannot be read ({describe_error(error)}): delete it, and fetch {model.name} again"
        ) from error


def record_in_lock(model: ModelEntry, commit: str, files: Mapping[str, WeightFile]) -> None:
    """Record the sizes and hashes of files that were fetched."""
    commits = read_lock(model)
    commits[commit] = {**commits.get(commit, {}), **files}
    tree = {
        "format": LOCK_FORMAT,
        "commits": {
            at: {name: {"size": own.size, "sha256": own.sha256} for name, own in sorted(known.items())}
            for at, known in sorted(commits.items())
        },
    }
    write_atomic(locate_repository(model) / LOCK_NAME, (json.dumps(tree, indent=2) + "\n").encode())
