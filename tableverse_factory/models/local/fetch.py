"""Download of weights from the Hugging Face Hub into its cache: resumed, bounded, and checked before it is in place."""

import fcntl
import io
import os
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from tableverse_factory.core.errors import InputError, WeightsError
from tableverse_factory.core.file_hash import hash_file
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.core.storage.files import sync_folder
from tableverse_factory.models.local.catalogue import ModelEntry, WeightFile
from tableverse_factory.models.local.hf_weights import (
    GIT_HASH,
    describe_refusal,
    is_unreachable,
    pin_commit,
    shorten_error,
)
from tableverse_factory.models.local.weight_files import (
    SHA256,
    check_file,
    hash_git_blob,
    locate_file,
    locate_repository,
    read_lock,
    record_in_lock,
)

MAX_FILE_BYTES = 16 * 1024**3
MAX_SMALL_BYTES = 64 * 1024**2  # of a file that is no weights
SPARE_BYTES = 1024**3  # left free on the disk
_LIBRARY = "tableverse-factory"


@dataclass(frozen=True, slots=True)
class FetchedFile:
    """A file after a fetch; `how` is `present` if it was there already."""

    name: str
    size: int
    sha256: str
    how: Literal["present", "fetched"]


@dataclass(frozen=True, slots=True)
class _Offer:
    """A file as the Hub announces it, before any of it is downloaded."""

    url: str
    etag: str  # sha256 of large files, git's hash of small ones
    size: int


def fetch_model(model: ModelEntry, announce: Callable[[str], None]) -> tuple[str, tuple[FetchedFile, ...]]:
    """Fetch what is missing or damaged of a model; return its commit and files. `announce` gets a line per download.

    A download that is broken off goes on at the next call. Files are held to the catalogue, else to the lock of the
    first fetch, and always to the hash that the Hub names them by.

    Raises:
        InputError: if its weights are fetched by another program.
        WeightsError: if the Hub refuses, cannot be reached, or sends something else.
    """
    if not model.files:
        raise InputError(f"{model.name} is not fetched here: see {model.loaded_by}", "no_such_model")
    commit = model.revision
    if not GIT_HASH.fullmatch(commit):
        commit = pin_commit(model.weights, model.name).rpartition("@")[2]
    if not GIT_HASH.fullmatch(commit):
        raise WeightsError(f"{model.weights}: the hub names no commit of 40 digits, but {commit!r:.80}")
    lock = read_lock(model).get(commit, {})
    fetched = tuple(_fetch_file(model, commit, file, lock.get(file.name), announce) for file in model.files)
    record_in_lock(model, commit, {file.name: WeightFile(file.name, file.size, file.sha256) for file in fetched})
    return commit, fetched


def _fetch_file(
    model: ModelEntry, commit: str, file: WeightFile, locked: WeightFile | None, announce: Callable[[str], None]
) -> FetchedFile:
    path = locate_file(model, commit, file.name)
    here = check_file(model, commit, file, locked)
    if here.state == "present":
        return FetchedFile(file.name, path.stat().st_size, here.sha256 or hash_file(path), "present")
    known = locked or file
    wanted = WeightFile(file.name, file.size or known.size, file.sha256 or known.sha256)
    offer = _read_offer(model, commit, wanted)
    blob = locate_repository(model) / "blobs" / offer.etag
    _require_space(blob, offer.size)
    announce(f"{model.name}: {file.name}, {offer.size / 1e6:.1f} MB")
    blob.parent.mkdir(parents=True, exist_ok=True)
    found = _download_blob(model, commit, offer, wanted, blob)
    if here.state == "damaged":
        path.unlink()
    _link_blob(model, commit, file.name)
    return FetchedFile(file.name, offer.size, found, "fetched")


def _read_offer(model: ModelEntry, commit: str, wanted: WeightFile) -> _Offer:
    """Ask the Hub for size and hash of a file; WeightsError if they are not those that are wanted."""
    hub = _import_hub()
    url = hub.hf_hub_url(model.repository, wanted.name, revision=commit)
    try:
        found = hub.get_hf_file_metadata(url, timeout=hub.constants.HF_HUB_ETAG_TIMEOUT, library_name=_LIBRARY)
    except Exception as error:
        raise _make_error(model, commit, wanted.name, error) from error
    etag, size, name = str(found.etag or ""), found.size, f"{model.name}: {wanted.name}"
    if found.commit_hash != commit or size is None or not (SHA256.fullmatch(etag) or GIT_HASH.fullmatch(etag)):
        raise WeightsError(f"{name}: what HF_ENDPOINT names tells no commit, size and hash of it: it is no hub")
    if wanted.size is not None and size != wanted.size:
        raise WeightsError(f"{name}: the hub offers {size} bytes, and {wanted.size} are known: not fetched")
    if wanted.sha256 and SHA256.fullmatch(etag) and etag != wanted.sha256:
        raise WeightsError(f"{name}: the hub offers sha256 {etag}, and {wanted.sha256} is known: not fetched")
    most = MAX_FILE_BYTES if wanted.name.endswith(".safetensors") else MAX_SMALL_BYTES
    if size > most:
        raise WeightsError(f"{name}: {size} bytes are more than the {most} that are allowed: not fetched")
    return _Offer(url, etag, size)


def _require_space(blob: Path, size: int) -> None:
    there = next(parent for parent in blob.parents if parent.exists())
    free = shutil.disk_usage(there).free
    if free < size + SPARE_BYTES:
        raise WeightsError(
            f"{there}: {free / 1e9:.1f} GB are free, and {(size + SPARE_BYTES) / 1e9:.1f} are needed: make room, or "
            "set HF_HOME to a folder on another disk"
        )


def _download_blob(model: ModelEntry, commit: str, offer: _Offer, wanted: WeightFile, blob: Path) -> str:
    """Download a file beside its place, check it, and move it there; return its sha256.

    What arrived before an interruption stays in `*.partial`, whose lock keeps another process out.
    """
    partial = blob.with_name(f"{blob.name}.partial")
    with _PartialFile(partial, offer.size, f"{model.name}: {wanted.name}") as file:
        try:
            file.download(offer)
        except WeightsError:
            partial.unlink()
            raise
        except Exception as error:
            raise _make_error(model, commit, wanted.name, error, has_begun=partial.stat().st_size > 0) from error
        found = hash_file(partial)
        right = found == (wanted.sha256 or found)
        by_name = found if SHA256.fullmatch(offer.etag) else hash_git_blob(partial)
        if not right or by_name != offer.etag:
            partial.unlink()
            known = wanted.sha256 if not right else offer.etag
            raise WeightsError(
                f"{model.name}: {wanted.name} arrived with sha256 {found}, and not as {known}: it was deleted; fetch "
                "it again, and if that does not help, something between the hub and here changes it"
            )
        partial.replace(blob)
    sync_folder(blob.parent)
    return found


class _PartialFile(io.BufferedRandom):
    """A file that is downloaded, locked for this process, which refuses more bytes than were announced."""

    def __init__(self, path: Path, size: int, name: str) -> None:
        super().__init__(io.FileIO(os.open(path, os.O_RDWR | os.O_CREAT, 0o644), "r+"))
        self._limit, self._name = size, name
        try:
            fcntl.flock(self.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_there = path.exists() and os.fstat(self.fileno()).st_ino == path.stat().st_ino
        except BlockingIOError:
            is_there = False
        if not is_there:  # another process has it, or has just moved it to its place
            self.close()
            raise WeightsError(f"{name} is being fetched by another process: wait for it, then run this again")

    def write(self, data: Any) -> int:
        if self.tell() + len(data) > self._limit:
            raise WeightsError(f"{self._name}: the hub sends more than the {self._limit} bytes that it announced")
        return super().write(data)

    def download(self, offer: _Offer) -> None:
        """Download what is missing of the file, and write it to the disk."""
        hub = _import_hub()
        there = self.seek(0, os.SEEK_END)
        if there > offer.size:
            self.truncate(0)
            there = self.seek(0)
        headers = hub.utils.build_hf_headers(library_name=_LIBRARY)
        hub.file_download.http_get(offer.url, self, resume_size=there, headers=headers, expected_size=offer.size)
        self.flush()
        os.fsync(self.fileno())


def _link_blob(model: ModelEntry, commit: str, name: str) -> None:
    """Let huggingface_hub enter a blob that is in place under its name at the commit."""
    try:
        _import_hub().hf_hub_download(model.repository, name, revision=commit, library_name=_LIBRARY)
    except Exception as error:
        raise _make_error(model, commit, name, error) from error


def _make_error(model: ModelEntry, commit: str, name: str, error: Exception, has_begun: bool = False) -> WeightsError:
    weights = f"{model.repository}@{commit}"
    if "EntryNotFound" in type(error).__name__:
        return WeightsError(f"{model.name} = {weights!r} holds no {name}: is the revision right?")
    if refusal := describe_refusal(error, weights, model.name):
        return WeightsError(refusal)
    if is_unreachable(error) and not has_begun:
        return WeightsError(
            f"{model.name}: the hub cannot be reached to fetch {name} ({shorten_error(error)}): look at the network, "
            "its proxy and HF_ENDPOINT, then run the same command again"
        )
    goes_on = ", which goes on with what arrived" if has_begun else ""
    return WeightsError(
        f"{model.name}: {name} cannot be fetched ({shorten_error(error)}): run the same command again{goes_on}"
    )


def _import_hub() -> Any:
    hub: Any = import_extra("huggingface_hub", "fetching models", "models")
    for part in ("constants", "file_download", "utils"):
        import_extra(f"huggingface_hub.{part}", "fetching models", "models")
    hub.utils.logging.set_verbosity_error()  # its warnings hold addresses
    return hub
