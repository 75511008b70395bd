"""Store of fetched pictures: files named by their content, and an index of the addresses they came from."""

import json
from pathlib import Path

from schemas.identity import content_hash
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.files import make_write_error, write_atomic

INDEX_NAME = "index.jsonl"
SUFFIXES = {"JPEG": ".jpg", "MPO": ".jpg", "PNG": ".png", "WEBP": ".webp"}
"""File suffixes by Pillow's name of the format."""


class ImageStore:
    """Pictures fetched by this run and earlier ones.

    `<folder>/<first two digits>/<digest>.jpg` holds the bytes as they came; `index.jsonl` has a line for each address,
    which it holds as a digest, for addresses may hold secrets. A picture is written before its line, and believed only
    if its bytes have the digest of its name: a run that was killed costs what was under way.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()
        self._index = self.folder / INDEX_NAME
        self._names: dict[str, str] = {}
        self._written: set[Path] = set()
        self._ends_in_line = True
        self._read_index()

    def _read_index(self) -> None:
        try:
            data = self._index.read_bytes()
        except FileNotFoundError:
            return
        except OSError as error:
            raise InputError(f"{self._index} cannot be read: {error.strerror}") from None
        self._ends_in_line = data.endswith(b"\n")
        for line in data.splitlines():
            try:
                entry = json.loads(line)
                url, digest, suffix = entry["url"], entry["content"], entry["suffix"]
            except (ValueError, TypeError, KeyError):
                continue  # torn by a kill: what it named is fetched again
            if isinstance(url, str) and _is_digest(digest) and suffix in SUFFIXES.values():
                self._names[url] = f"{digest}{suffix}"

    def find(self, url: str) -> Path | None:
        """Find the picture of an address; None if it is missing or damaged."""
        name = self._names.get(content_hash(url.encode("utf-8", "surrogatepass")))
        if name is None:
            return None
        path = self._path(name)
        try:
            return path if content_hash(path.read_bytes()) == path.stem else None
        except OSError:  # it went: it is fetched again
            return None

    def store(self, url: str, data: bytes, suffix: str) -> Path:
        """Store the bytes of an address."""
        digest = content_hash(data)
        path = self._path(f"{digest}{suffix}")
        if path not in self._written:
            write_atomic(path, data)
            self._written.add(path)
        key = content_hash(url.encode("utf-8", "surrogatepass"))
        line = json.dumps({"url": key, "content": digest, "suffix": suffix}) + "\n"
        try:
            with self._index.open("a") as file:
                file.write(line if self._ends_in_line else "\n" + line)
        except OSError as error:
            raise make_write_error(self._index, error) from error
        self._ends_in_line = True
        self._names[key] = path.name
        return path

    def _path(self, name: str) -> Path:
        return self.folder / name[:2] / name


def _is_digest(value: object) -> bool:
    return isinstance(value, str) and len(value) == 64 and all(c in "0123456789abcdef" for c in value)
