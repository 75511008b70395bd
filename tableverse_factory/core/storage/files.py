"""Paths on the disk or in an object store, and files that are either whole or absent in both.

A storage path is a `pathlib.Path`, or a `UPath` for `s3://bucket/prefix`. On the disk a file is written under a
temporary name, flushed and renamed; in a store an upload appears when it is complete.
"""

import importlib.util
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO, TypeAlias

import fsspec
from upath import UPath

from tableverse_factory.core.errors import BuildError, InputError, StoreError
from tableverse_factory.core.text import sanitize_line

if TYPE_CHECKING:
    from tableverse_factory.core.storage.s3 import ObjectStore

StoragePath: TypeAlias = Path | UPath

MAX_URI_CHARS = 1024
PARTIAL = ".partial"  # suffix of a file on the disk that is being written
_PART_BYTES = 16 * 1024**2
_READ_AHEAD_BYTES = 4 * 1024**2
_BUCKET = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{1,61}[A-Za-z0-9]")
_SECRET = re.compile(r"(?<=://)[^/]*@")
_NEEDS_S3 = "s3:// needs s3fs: pip install 'tableverse-factory[s3]'"

fsspec.register_implementation("s3", "tableverse_factory.core.storage.s3.ObjectStore", clobber=True, errtxt=_NEEDS_S3)


def parse_path(text: str) -> StoragePath:
    """Parse a path that a user gave: a local path, `file:///path`, or `s3://bucket/prefix` without secrets."""
    scheme, separator, rest = text.partition("://")
    if not separator:
        return Path(text)
    if len(text) > MAX_URI_CHARS or not text.isprintable():
        raise InputError(f"an address has at most {MAX_URI_CHARS} printable characters")
    if scheme == "file" and rest.startswith("/"):
        return Path(rest)
    if scheme != "s3":
        raise InputError(f"{scheme[:20]}:// is no place for this: give a path, or s3://bucket/prefix")
    bucket, _, key = rest.partition("/")
    if "@" in bucket or ":" in bucket or "?" in rest or "#" in rest:
        raise InputError("give s3://bucket/prefix alone: credentials and endpoint belong into the AWS_* variables")
    if not _BUCKET.fullmatch(bucket):
        raise InputError(f"{bucket[:80]!r} is no name of a bucket: give s3://bucket/prefix")
    parts = key.rstrip("/").split("/")
    if any(part in (".", "..") for part in parts) or "" in parts[:-1]:
        raise InputError(f"{text}: a prefix has no empty part and no dots alone")
    if importlib.util.find_spec("s3fs") is None:
        raise InputError(_NEEDS_S3)
    path = UPath(f"s3://{bucket}/{key.rstrip('/')}")
    get_store(path)  # made once, here: the paths below share it, in all threads
    return path


def resolve_filesystem(uri: str) -> tuple[fsspec.AbstractFileSystem, str]:
    """Find the file system of a path or fsspec URI, and the path in it."""
    filesystem, path = fsspec.core.url_to_fs(uri)
    return filesystem, path


def redact_uri(uri: str) -> str:
    """Redact an address for messages: printable, without user, password and query."""
    plain = _SECRET.sub("", uri).partition("?")[0] if "://" in uri else uri
    return sanitize_line(plain, MAX_URI_CHARS)


def get_store(path: UPath) -> "ObjectStore":
    """Get the object store of a remote path."""
    return path.fs


def list_names(folder: StoragePath) -> list[str]:
    """List the names in a folder, sorted, hidden ones too; a missing folder is empty."""
    if isinstance(folder, UPath):
        return list(get_store(folder).list_sizes(folder.path))
    try:
        return sorted(path.name for path in folder.iterdir())
    except (FileNotFoundError, NotADirectoryError):
        return []


def list_sizes(folder: StoragePath) -> dict[str, int]:
    """List the files in a folder by name with their sizes [bytes]; a missing folder is empty."""
    if isinstance(folder, UPath):
        return dict(get_store(folder).list_sizes(folder.path))
    try:
        return {path.name: path.stat().st_size for path in sorted(folder.iterdir()) if path.is_file()}
    except (FileNotFoundError, NotADirectoryError):
        return {}


@contextmanager
def atomic_file(path: StoragePath) -> Iterator[BinaryIO]:
    """Open a file, in folders made if missing, that replaces `path` only if the block ends without an error."""
    write = _write_multipart(path) if isinstance(path, UPath) else _write_and_rename(path)
    with translate_write_errors(path), write as file:
        yield file


@contextmanager
def translate_write_errors(path: StoragePath) -> Iterator[None]:
    """Raise an OSError of the block as the error that stops a build."""
    try:
        yield
    except OSError as error:
        raise make_write_error(path, error) from error


@contextmanager
def _write_and_rename(path: Path) -> Iterator[BinaryIO]:
    partial = path.with_name(path.name + PARTIAL)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with partial.open("wb") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        partial.replace(path)
        sync_folder(path.parent)
    finally:
        with suppress(OSError):  # it is gone after the rename; an earlier error matters more
            partial.unlink()


@contextmanager
def _write_multipart(path: UPath) -> Iterator[BinaryIO]:
    """Upload in parts, one in memory at a time; the next build aborts parts that a kill leaves."""
    file = path.fs.open(path.path, "wb", block_size=_PART_BYTES, autocommit=False)
    try:
        yield file
        file.close()
        file.commit()
    except BaseException:
        file.closed = True  # or its finalizer would write the rest
        with suppress(OSError):  # the first error matters more
            file.discard()
        raise


def write_atomic(path: StoragePath, data: bytes) -> None:
    """Write a small file, whole or not at all."""
    if isinstance(path, UPath):
        with translate_write_errors(path):
            path.fs.pipe_file(path.path, data)
        return
    with atomic_file(path) as file:
        file.write(data)


def move(source: StoragePath, target: StoragePath) -> None:
    """Move a finished file over `target` in one step; in a store it is copied, and `source` stays."""
    with translate_write_errors(target):
        if isinstance(source, UPath) and isinstance(target, UPath):
            source.fs.cp_file(source.path, target.path)
        elif isinstance(source, Path) and isinstance(target, Path):
            target.parent.mkdir(parents=True, exist_ok=True)
            source.replace(target)
            sync_folder(target.parent)
        else:
            raise ValueError(f"{source} and {target} are not in the same store")


def remove(path: StoragePath) -> None:
    """Remove a file if it exists."""
    with translate_write_errors(path):
        if isinstance(path, UPath):
            get_store(path).remove(path.path)
        else:
            path.unlink(missing_ok=True)


def remove_folder(folder: StoragePath, keep: str = "") -> None:
    """Remove a folder and everything below it, if it exists, except the entry named `keep`."""
    with translate_write_errors(folder):
        if isinstance(folder, UPath):
            get_store(folder).remove_all(folder.path, keep)
        elif not keep and folder.exists():
            shutil.rmtree(folder)
        else:
            for path in (folder / name for name in list_names(folder) if name != keep):
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def open_stream(path: StoragePath) -> BinaryIO:
    """Open a file that is read front to back; from a store a few megabytes are fetched ahead."""
    if isinstance(path, UPath):
        return path.fs.open(path.path, "rb", block_size=_READ_AHEAD_BYTES, cache_type="readahead")
    return path.open("rb")


def read_whole(path: StoragePath) -> bytes:
    """Read all of a file."""
    return path.fs.cat_file(path.path) if isinstance(path, UPath) else path.read_bytes()


def read_range(path: StoragePath, offset: int, size: int) -> bytes:
    """Read some bytes of a file, fewer where it ends earlier."""
    if isinstance(path, UPath):
        return path.fs.cat_file(path.path, start=offset, end=offset + size)
    with path.open("rb") as file:
        file.seek(offset)
        return file.read(size)


def abort_uploads(folder: StoragePath) -> None:
    """Abort incomplete uploads below a folder of a store, whose parts would be billed."""
    if isinstance(folder, UPath):
        get_store(folder).abort_uploads(folder.path)


def sync_folder(folder: Path) -> None:
    """Flush a folder, so that new names and renames in it survive a loss of power."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_missing_build_error(path: StoragePath) -> BuildError:
    """Make the error for a missing file that every build has."""
    folder, shown = path.parent, sanitize_line(str(path.parent))
    if isinstance(folder, Path) and not folder.exists():
        return BuildError(f"{shown}: there is no such folder; give the OUT of `tableverse build`")
    return BuildError(f"{shown} holds no build: {path.name} is missing; give the OUT of `tableverse build`")


def make_write_error(path: StoragePath, error: OSError) -> BuildError:
    """Make the error that stops a build whose disk or store refuses a write."""
    if isinstance(error, StoreError):
        return BuildError(str(error))
    return BuildError(
        f"cannot write {path}: {error.strerror or error}: make room or fix the permissions, then run the same command "
        "to go on"
    )
