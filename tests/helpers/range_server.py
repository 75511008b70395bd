"""A folder behind a real HTTP server on this machine that serves ranges, counts what it sends, and fails on purpose."""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from urllib.parse import unquote, urlsplit

from tests.helpers.loopback import serving


@dataclass
class RangeServer:
    """What it serves, what it has sent, and what it does wrong.

    Attributes:
        sent: Bytes of bodies by path below the folder.
        asked: Questions by path.
        fault: Called with the handler and the path before an answer; True where it has answered itself.
        ranges: Whether it serves ranges at all.
    """

    folder: Path
    address: str = ""
    sent: Counter[str] = field(default_factory=Counter)
    asked: Counter[str] = field(default_factory=Counter)
    fault: Callable[["Handler", str], bool] | None = None
    ranges: bool = True

    def forget(self) -> None:
        self.sent.clear()
        self.asked.clear()


class Handler(BaseHTTPRequestHandler):
    """Answers GET as nginx does for a folder of files."""

    protocol_version = "HTTP/1.1"
    owner: RangeServer

    def do_GET(self) -> None:
        name = unquote(urlsplit(self.path).path).lstrip("/")
        self.owner.asked[name] += 1
        if self.owner.fault is not None and self.owner.fault(self, name):
            return
        path = self.owner.folder / name
        if not path.is_file():
            self.answer(404, b"no")
            return
        size = path.stat().st_size
        start, stop = self.span(size)
        if start >= size > 0:
            self.answer(416, b"", {"Content-Range": f"bytes */{size}"})
            return
        headers = {"ETag": f'"{path.stat().st_mtime_ns}-{size}"'}
        if self.owner.ranges and "Range" in self.headers:
            headers["Content-Range"] = f"bytes {start}-{stop - 1}/{size}"
        with path.open("rb") as file:
            file.seek(start)
            self.answer(206 if "Content-Range" in headers else 200, file.read(stop - start), headers, name)

    def span(self, size: int) -> tuple[int, int]:
        said = self.headers.get("Range", "")
        if not self.owner.ranges or not said:
            return 0, min(size, 50_000_000)
        first, _, last = said.removeprefix("bytes=").partition("-")
        return int(first), min(size, int(last) + 1)

    def answer(self, status: int, body: bytes, headers: dict[str, str] | None = None, name: str = "") -> None:
        self.send_response(status)
        for key, value in {"Content-Length": str(len(body)), **(headers or {})}.items():
            self.send_header(key, value)
        self.end_headers()
        self.owner.sent[name] += len(body)
        try:
            self.wfile.write(body)
        except OSError:  # whoever asked has seen enough
            self.close_connection = True

    def log_message(self, *_: object) -> None:
        time.sleep(0)


@contextmanager
def range_server(folder: Path, host: str = "127.0.0.1") -> Iterator[RangeServer]:
    """Serves a folder until the block ends."""
    owner = RangeServer(folder)
    with serving(type("Owned", (Handler,), {"owner": owner}), host) as owner.address:
        yield owner
