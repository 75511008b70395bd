"""Disk cache with a file per key: a hash, then the bytes. Safe to share between processes and to delete at any time."""

import os
import tempfile
import time
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from schemas.identity import content_hash

_DIGEST_BYTES = 64
_PARTIAL = ".part"  # suffix of a file that is being written
_STALE_S = 86_400.0  # age at which its writer must have been killed [s]


@dataclass(frozen=True, slots=True)
class DiskCache:
    """Files in a folder under keys, which are hashes; `durable` flushes each file to the disk."""

    folder: Path
    suffix: str
    durable: bool = False

    def get(self, key: str) -> bytes | None:
        """Get the bytes of a key; None if there are none, or the file is damaged."""
        try:
            data = self._path(key).read_bytes()
        except OSError:
            return None
        digest, payload = data[:_DIGEST_BYTES], data[_DIGEST_BYTES:]
        return payload if digest == content_hash(payload).encode() else None

    def put(self, key: str, payload: bytes) -> None:
        """Write the bytes of a key, whole or not at all, also when other processes write the same."""
        path = self._path(key)
        path.parent.mkdir(parents=True, exist_ok=True)
        _remove_stale_parts(path.parent)
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=_PARTIAL)
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content_hash(payload).encode() + payload)
                if self.durable:
                    file.flush()
                    os.fsync(file.fileno())
            Path(temporary).replace(path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise

    def _path(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}{self.suffix}"


@cache  # once per process: a kill is rare, and listing a folder takes time
def _remove_stale_parts(folder: Path) -> None:
    """Remove files whose writers were killed."""
    for path in folder.glob(f"*{_PARTIAL}"):
        with suppress(OSError):  # another process removes it too
            if time.time() - path.stat().st_mtime > _STALE_S:
                path.unlink()
