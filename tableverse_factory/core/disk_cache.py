"""Disk cache with a file per key: a hash, then the bytes. Safe to share between processes and to delete at any time."""

import os
import tempfile
from dataclasses import dataclass
from pathlib import Path

from schemas.identity import content_hash

_DIGEST_BYTES = 64


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
        handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".part")
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(content_hash(payload).encode() + payload)
                if self.durable:
                    file.flush()
                    os.fsync(file.fileno())
            Path(temporary).replace(path)
        except OSError:
            Path(temporary).unlink(missing_ok=True)
            raise

    def _path(self, key: str) -> Path:
        return self.folder / key[:2] / f"{key}{self.suffix}"
