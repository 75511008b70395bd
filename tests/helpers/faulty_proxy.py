"""An HTTP proxy in front of a server that fails on purpose, and remembers what went through it."""

import http.client
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from urllib.parse import urlsplit

from tests.helpers.loopback import serving

ERROR = b"<?xml version='1.0'?><Error><Code>InternalError</Code><Message>We are sorry</Message></Error>"
DENIED = b"<?xml version='1.0'?><Error><Code>AccessDenied</Code><Message>No</Message></Error>"
_HOP = {"connection", "keep-alive", "transfer-encoding", "content-length"}


@dataclass
class Passed:
    """One request: what it asked, and how many bytes its answer had."""

    method: str
    path: str
    answered: int = 0


@dataclass
class FaultyProxy:
    """Where it listens, what it does to a request, and what it saw.

    A fault is None (pass on), `denied` (403), `error` (500 instead of an answer), `lost` (done, but answered with 500),
    `silent` (no answer before the client gives up), `cut` (half of the answer's body), `refused` (closed at once).
    Headers in `deaf_to` do not reach the server.
    """

    endpoint: str = ""
    fault: Callable[[str, str], str | None] = lambda method, path: None
    silence_s: float = 2.5
    passed: list[Passed] = field(default_factory=list)
    faults: int = 0
    deaf_to: frozenset[str] = frozenset()


@contextmanager
def faulty_proxy(target: str) -> Iterator[FaultyProxy]:
    proxy = FaultyProxy()
    address = urlsplit(target)

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def handle_any(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            seen = Passed(self.command, self.path)
            proxy.passed.append(seen)
            fault = proxy.fault(self.command, self.path)
            proxy.faults += fault is not None
            if fault == "refused":
                self.close_connection = True
                return
            if fault == "silent":
                time.sleep(proxy.silence_s)
                self.close_connection = True
                return
            if fault == "denied":
                self.answer(403, {"Content-Type": "application/xml"}, DENIED)
                return
            if fault == "error":
                self.answer(500, {"Content-Type": "application/xml"}, ERROR)
                return
            upstream = http.client.HTTPConnection(address.hostname, address.port, timeout=30)
            headers = {name: value for name, value in self.headers.items() if name.lower() not in proxy.deaf_to}
            upstream.request(self.command, self.path, body, headers)
            answer = upstream.getresponse()
            data = answer.read()
            seen.answered = len(data)
            headers = {name: value for name, value in answer.getheaders() if name.lower() not in _HOP}
            if self.command == "HEAD":
                headers["Content-Length"] = answer.headers.get("Content-Length", "0")
            upstream.close()
            if fault == "lost":
                self.answer(500, {"Content-Type": "application/xml"}, ERROR)
                return
            self.answer(answer.status, headers, data, cut=fault == "cut")

        def answer(self, status: int, headers: dict[str, str], data: bytes, cut: bool = False) -> None:
            self.send_response(status)
            for name, value in headers.items():
                self.send_header(name, value)
            if "Content-Length" not in headers:
                self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            if self.command != "HEAD":
                self.wfile.write(data[: len(data) // 2] if cut else data)
            self.close_connection = self.close_connection or cut

        do_GET = do_PUT = do_POST = do_DELETE = do_HEAD = handle_any  # noqa: N815

        def log_message(self, *args: object) -> None:
            pass

    with serving(Handler) as proxy.endpoint:
        yield proxy
