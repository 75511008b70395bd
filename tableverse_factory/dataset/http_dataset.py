"""A dataset behind HTTP as a file system: what lies there is known from its plan, because HTTP has no folders."""

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

MAX_WHOLE_BYTES = 512 * 1024**2
"""Of a file that is read whole, such as the plan."""

_HEAD_BYTES = 64 * 1024
_AT_ONCE = 16
_MAY_LACK = frozenset({"scenes", MERGED, *SPARSE})
"""Folders in which a dataset may lack a file."""

_PLAIN = re.compile(r"[^\s\x00-\x1f\x7f\\]+")


class WebFolder(AbstractFileSystem):  # type: ignore[misc]
    """The files of one dataset below an address; paths are whole addresses.

    A file that has another version or length than when it was first read is an error, never a mixture; one that was not
    there is not asked for again. Servers that may not list what they hold, as public buckets do, refuse what is not
    there: beside a record that is readable, such a refusal means that a file which may be missing is.
    """

    protocol = "tableverse-web"
    cachable = False  # what was seen of a dataset ends with it

    def __init__(self, address: str, **options: Any) -> None:
        """Asks for nothing yet.

        Args:
            address: Of the folder, as `check_web_address` gives it.
            options: Of fsspec.
        """
        super().__init__(address, **options)
        self.address = address
        self._ranges = HttpRangeReader(self.headers)
        self._versions: dict[str, tuple[int, str]] = {}
        self._absent: set[str] = set()
        self._refused: set[str] = set()

    @classmethod
    def _strip_protocol(cls, path: str) -> str:
        return path.rstrip("/")

    def headers(self) -> Mapping[str, str]:
        """What the host of `address` is told with every question."""
        return {}

    def isdir(self, path: str) -> bool:
        """Whether there is a dataset, or one of its folders."""
        if path.rstrip("/") == self.address:
            return self.exists(f"{self.address}/run.json")
        return bool(self.ls(path))

    def exists(self, path: str, **_: Any) -> bool:
        """Whether there is such a file."""
        try:
            self.info(path)
        except FileNotFoundError:
            return False
        return True

    def info(self, path: str, **_: Any) -> dict[str, Any]:
        """Name, type and size [bytes] of a file; nothing of it is read."""
        if path not in self._versions:
            self._asked(path, self._ranges.read_size)
        return {"name": path, "type": "file", "size": self._versions[path][0]}

    def ls(self, path: str, detail: bool = True, **_: Any) -> list[Any]:
        """The files in a folder that belong to shards; a question for each, sixteen at a time."""
        sizes = self.sizes(path.rstrip("/").removeprefix(self.address).strip("/"))
        found = [{"name": f"{path.rstrip('/')}/{name}", "type": "file", "size": sizes[name]} for name in sizes]
        return found if detail else [entry["name"] for entry in found]

    def sizes(self, folder: str) -> dict[str, int]:
        """Names and sizes [bytes] of the shards' files in a folder of the dataset."""
        if folder not in FOLDERS | SPARSE:
            return {}
        names = [shard_name(folder, number) for number in self.planned_shards]
        paths = {name: f"{self.address}/{folder}/{name}" for name in names}
        with ThreadPoolExecutor(_AT_ONCE) as threads:
            sizes = dict(zip(paths, threads.map(self._size, paths.values()), strict=True))
        found = {name: size for name, size in sizes.items() if size is not None}
        if folder == "scenes" and not found and (refused := self._refused.intersection(paths.values())):
            raise StoreError(
                f"{redact_uri(min(refused))}: the server refuses every shard: they are private, or not there yet"
            )
        return found

    @cached_property
    def planned_shards(self) -> tuple[int, ...]:
        """Numbers of the shards that the plan names, in order: never more than it has rows.

        Raises:
            StoreError: if there is no plan, or it is none.
        """
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
        """Some bytes of a file, and nothing else of it; without bounds all of it."""
        if end is not None:
            return self._piece(path, start or 0, end).data
        head = self._piece(path, start or 0, (start or 0) + _HEAD_BYTES)
        if head.total > MAX_WHOLE_BYTES:
            raise StoreError(f"{redact_uri(path)}: {head.total} bytes; at most {MAX_WHOLE_BYTES} are read at once")
        read = (start or 0) + len(head.data)
        return head.data if read >= head.total else head.data + self._piece(path, read, head.total).data

    def _open(self, path: str, mode: str = "rb", **_: Any) -> BinaryIO:
        """A file that reads exactly what it is asked for; a small one is fetched at once."""
        if mode != "rb":
            raise StoreError(f"{redact_uri(path)}: a dataset on the web is read only")
        if path in self._versions and self._versions[path][0] > _HEAD_BYTES:
            return _WebFile(self, path, size=self._versions[path][0], cache_type="none")
        head = self._piece(path, 0, _HEAD_BYTES)
        whole = len(head.data) == head.total
        return io.BytesIO(head.data) if whole else _WebFile(self, path, size=head.total, cache_type="none")

    def _size(self, path: str) -> int | None:
        try:
            return int(self.info(path)["size"])
        except FileNotFoundError:
            return None

    def _piece(self, path: str, start: int, stop: int) -> ByteRange:
        if stop <= start:
            return ByteRange(b"", self.info(path)["size"], "")
        return self._asked(path, lambda address: self._ranges.read(address, start, stop))

    def _asked(self, path: str, ask: Callable[[str], ByteRange]) -> ByteRange:
        if path in self._absent:
            raise FileNotFoundError(f"{redact_uri(path)}: there is no such file")
        try:
            piece = ask(self.address + quote(path.removeprefix(self.address)))
        except FileNotFoundError:
            self._absent.add(path)
            raise
        except RefusedError:
            if not self._may_lack(path):
                raise
            self._refused.add(path)
            self._absent.add(path)
            raise FileNotFoundError(f"{redact_uri(path)}: there is no such file") from None
        return self._known(path, piece)

    def _may_lack(self, path: str) -> bool:
        folder = path.removeprefix(self.address).strip("/").partition("/")[0]
        return folder in _MAY_LACK and self.exists(f"{self.address}/run.json")

    def _known(self, path: str, piece: ByteRange) -> ByteRange:
        """The piece, if it is of the file that was seen first."""
        if self._versions.setdefault(path, (piece.total, piece.version)) != (piece.total, piece.version):
            raise StoreError(f"{redact_uri(path)}: it changed since the dataset was opened: open it again")
        return piece


class _WebFile(AbstractBufferedFile):  # type: ignore[misc]
    def _fetch_range(self, start: int, end: int) -> bytes:
        data: bytes = self.fs.cat_file(self.path, start, end)
        return data


def check_web_address(text: str) -> str:
    """The address of a dataset on the web, without a slash at its end.

    Raises:
        InputError: if it is none, or holds a secret or a query.
    """
    try:
        parts = urlsplit(text)
        _ = parts.port
    except ValueError:
        raise InputError("that is no address: give https://HOST/PATH") from None
    if len(text) > MAX_URI_CHARS or not _PLAIN.fullmatch(text) or not parts.hostname:
        raise InputError("that is no address: give https://HOST/PATH")
    if "@" in parts.netloc or parts.query or parts.fragment or "?" in text or "#" in text:
        raise InputError("give https://HOST/PATH alone, without user, query and fragment")
    return text.rstrip("/")
