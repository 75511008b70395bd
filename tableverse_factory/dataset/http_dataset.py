"""Dataset behind HTTP as a file system, whose files are known from its plan because HTTP lists no folders."""

import io
import re
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cached_property
from typing import Any, BinaryIO
from urllib.parse import quote, urlsplit

import pyarrow as pa
from fsspec.spec import AbstractBufferedFile, AbstractFileSystem

from tableverse_factory.core.errors import InputError, StoreError
from tableverse_factory.core.storage.files import MAX_URI_CHARS, redact_uri
from tableverse_factory.core.storage.http import ByteRange, HttpRangeReader, RefusedError
from tableverse_factory.core.storage.parquet import read_remote_table
from tableverse_factory.dataset.consolidated_tables import MERGED
from tableverse_factory.dataset.shard_plan import MAX_SHARDS, PLAN
from tableverse_factory.dataset.shards import FOLDERS, SPARSE, shard_name

MAX_WHOLE_BYTES = 512 * 1024**2  # largest file that is read whole, such as the plan

_FIRST_READ_BYTES = 64 * 1024
_N_THREADS = 16
_OPTIONAL_FOLDERS = frozenset({"scenes", MERGED, *SPARSE})  # folders in which a dataset may lack a file
_ADDRESS_CHARS = re.compile(r"[^\s\x00-\x1f\x7f\\]+")


class WebFolder(AbstractFileSystem):  # type: ignore[misc]
    """Files of one dataset below an address; paths are whole addresses.

    A file whose version or length differs from the first read is an error, never a mixture; a missing file is not
    requested again. Servers that may not list their content, such as public buckets, refuse missing files: beside a
    readable record, such a refusal of an optional file means that it is missing.
    """

    protocol = "tableverse-web"
    cachable = False  # what was seen of a dataset ends with it

    def __init__(self, address: str, **options: Any) -> None:
        """Send no request yet; `address` is from `check_web_address`, `options` are fsspec's."""
        super().__init__(address, **options)
        self.address = address
        self._ranges = HttpRangeReader(self.headers)
        self._versions: dict[str, tuple[int, str]] = {}
        self._missing: set[str] = set()
        self._refused: set[str] = set()

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return path.rstrip("/")

    def headers(self) -> Mapping[str, str]:
        """Return the headers of every request to the host of `address`."""
        return {}

    def isdir(self, path: str) -> bool:
        """Return whether there is a dataset, or one of its folders."""
        if path.rstrip("/") == self.address:
            return self.exists(f"{self.address}/run.json")
        return bool(self.ls(path))

    def exists(self, path: str, **_: Any) -> bool:
        """Return whether there is such a file."""
        return self._find_size(path) is not None

    def info(self, path: str, **_: Any) -> dict[str, Any]:
        """Look up name, type and size [bytes] of a file without reading it."""
        if path not in self._versions:
            self._request(path, self._ranges.read_size)
        return {"name": path, "type": "file", "size": self._versions[path][0]}

    def ls(self, path: str, detail: bool = True, **_: Any) -> list[Any]:
        """List the files of shards in a folder, with a request for each, sixteen at a time."""
        sizes = self.sizes(path.rstrip("/").removeprefix(self.address).strip("/"))
        found = [{"name": f"{path.rstrip('/')}/{name}", "type": "file", "size": sizes[name]} for name in sizes]
        return found if detail else [entry["name"] for entry in found]

    def sizes(self, folder: str) -> dict[str, int]:
        """List the names and sizes [bytes] of the shards' files in a folder of the dataset."""
        if folder not in FOLDERS | SPARSE:
            return {}
        names = [shard_name(folder, number) for number in self.planned_shards]
        paths = {name: f"{self.address}/{folder}/{name}" for name in names}
        with ThreadPoolExecutor(_N_THREADS) as threads:
            sizes = dict(zip(paths, threads.map(self._find_size, paths.values()), strict=True))
        found = {name: size for name, size in sizes.items() if size is not None}
        if folder == "scenes" and not found and (refused := self._refused.intersection(paths.values())):
            raise StoreError(
                f"{redact_uri(min(refused))}: the server refuses every shard: they are private, or not there yet"
            )
        return found

    @cached_property
    def planned_shards(self) -> tuple[int, ...]:
        """Numbers of the shards in the plan, in order."""
        path = f"{self.address}/plan.parquet"
        try:
            shards = sorted(set(read_remote_table(self, path, PLAN, ("shard",))["shard"].to_pylist()))
        except FileNotFoundError:
            why = "HTTP lists no folders, so the shards are named by it"
            raise StoreError(f"{redact_uri(path)} is missing: {why}") from None
        except (pa.ArrowException, TypeError) as error:
            raise StoreError(f"{redact_uri(path)} is no plan: {' '.join(str(error).split())[:200]}") from None
        if shards and not 0 <= shards[0] <= shards[-1] < MAX_SHARDS:
            raise StoreError(f"{redact_uri(path)} is no plan: it speaks of shards {shards[0]} to {shards[-1]}")
        return tuple(shards)

    def cat_file(self, path: str, start: int | None = None, end: int | None = None, **_: Any) -> bytes:
        """Read a byte range of a file and nothing else; without bounds all of it."""
        if end is not None:
            return self._read_range(path, start or 0, end).data
        head = self._read_range(path, start or 0, (start or 0) + _FIRST_READ_BYTES)
        if head.total > MAX_WHOLE_BYTES:
            raise StoreError(f"{redact_uri(path)}: {head.total} bytes; at most {MAX_WHOLE_BYTES} are read at once")
        read = (start or 0) + len(head.data)
        return head.data if read >= head.total else head.data + self._read_range(path, read, head.total).data

    def _open(self, path: str, mode: str = "rb", **_: Any) -> BinaryIO:
        """Open a file that reads exactly what is asked for; a small one is fetched at once."""
        if mode != "rb":
            raise StoreError(f"{redact_uri(path)}: a dataset on the web is read only")
        if path in self._versions and self._versions[path][0] > _FIRST_READ_BYTES:
            return _WebFile(self, path, size=self._versions[path][0], cache_type="none")
        head = self._read_range(path, 0, _FIRST_READ_BYTES)
        whole = len(head.data) == head.total
        return io.BytesIO(head.data) if whole else _WebFile(self, path, size=head.total, cache_type="none")

    def _find_size(self, path: str) -> int | None:
        try:
            return int(self.info(path)["size"])
        except FileNotFoundError:
            return None

    def _read_range(self, path: str, start: int, stop: int) -> ByteRange:
        if stop <= start:
            return ByteRange(b"", self.info(path)["size"], "")
        return self._request(path, lambda address: self._ranges.read(address, start, stop))

    def _request(self, path: str, ask: Callable[[str], ByteRange]) -> ByteRange:
        if path in self._missing:
            raise FileNotFoundError(f"{redact_uri(path)}: there is no such file")
        try:
            piece = ask(self.address + quote(path.removeprefix(self.address)))
        except FileNotFoundError:
            self._missing.add(path)
            raise
        except RefusedError:
            folder = path.removeprefix(self.address).strip("/").partition("/")[0]
            if folder not in _OPTIONAL_FOLDERS or not self.exists(f"{self.address}/run.json"):
                raise
            self._refused.add(path)
            self._missing.add(path)
            raise FileNotFoundError(f"{redact_uri(path)}: there is no such file") from None
        if self._versions.setdefault(path, (piece.total, piece.version)) != (piece.total, piece.version):
            raise StoreError(f"{redact_uri(path)}: it changed since the dataset was opened: open it again")
        return piece


class _WebFile(AbstractBufferedFile):  # type: ignore[misc]
    def _fetch_range(self, start: int, end: int) -> bytes:
        return self.fs.cat_file(self.path, start, end)


def check_web_address(text: str) -> str:
    """Check the address of a dataset on the web, and return it without a slash at its end."""
    try:
        parts = urlsplit(text)
        _ = parts.port
    except ValueError:
        raise InputError("that is no address: give https://HOST/PATH") from None
    if len(text) > MAX_URI_CHARS or not _ADDRESS_CHARS.fullmatch(text) or not parts.hostname:
        raise InputError("that is no address: give https://HOST/PATH")
    if "@" in parts.netloc or parts.query or parts.fragment or "?" in text or "#" in text:
        raise InputError("give https://HOST/PATH alone, without user, query and fragment")
    return text.rstrip("/")
