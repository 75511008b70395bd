"""A server of pictures on this machine that misbehaves as it is told to, and remembers who asked for what."""

import gzip
import io
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler

import numpy as np
from PIL import Image

from tests.helpers.loopback import serving

Answer = Callable[[BaseHTTPRequestHandler, int], None]
"""Writes to the socket; told how often it was asked before."""


def photo(seed: int, size: tuple[int, int] = (400, 300)) -> Image.Image:
    """Blocks and speckles: sharp, of many greys, and unlike that of another seed."""
    draw = np.random.default_rng(seed)
    blocks = Image.fromarray(draw.integers(0, 255, (6, 8, 3), dtype=np.uint8)).resize(size, Image.Resampling.NEAREST)
    noise = draw.integers(-12, 12, (size[1], size[0], 3))
    return Image.fromarray(np.clip(np.asarray(blocks) + noise, 0, 255).astype(np.uint8))


def encoded(image: Image.Image, form: str = "JPEG", **options: object) -> bytes:
    out = io.BytesIO()
    image.save(out, form, **options)
    return out.getvalue()


def body(data: bytes, status: int = 200, **headers: str) -> Answer:
    """One sound answer; `content_length="5"` overrides what is true."""

    def write(request: BaseHTTPRequestHandler, _: int) -> None:
        request.send_response(status)
        for name, value in {"content_length": str(len(data)), "content_type": "image/jpeg", **headers}.items():
            request.send_header(name.replace("_", "-"), value)
        request.end_headers()
        request.wfile.write(data)

    return write


def in_turn(*answers: Answer) -> Answer:
    """One after the other, the last again and again."""
    return lambda request, before: answers[min(before, len(answers) - 1)](request, before)


def redirect(location: str) -> Answer:
    return body(b"", 302, location=location)


def endless(request: BaseHTTPRequestHandler, _: int) -> None:
    request.send_response(200)
    request.end_headers()
    for _ in range(10_000):
        request.wfile.write(b"\xff" * 65536)


def drip(request: BaseHTTPRequestHandler, _: int) -> None:
    request.send_response(200)
    request.end_headers()
    for _ in range(200):
        request.wfile.write(b"\xff")
        time.sleep(0.05)


def packed(data: bytes) -> Answer:
    return body(gzip.compress(data), content_encoding="gzip")


@dataclass
class PictureServer:
    """Its address, what lies under which path, and who asked.

    Attributes:
        asked: How often each path was asked for.
        agents: What called itself how.
        most: Most requests that were under way at a time.
    """

    url: str = ""
    answers: dict[str, Answer] = field(default_factory=dict)
    asked: Counter[str] = field(default_factory=Counter)
    agents: set[str] = field(default_factory=set)
    under_way: int = 0
    most: int = 0


@contextmanager
def picture_server() -> Iterator[PictureServer]:
    server = PictureServer()

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            path = self.path.partition("?")[0]
            before = server.asked[path]
            server.asked[path] += 1
            server.agents.add(self.headers["user-agent"])
            server.under_way += 1
            server.most = max(server.most, server.under_way)
            try:
                server.answers.get(path, body(b"", 404))(self, before)
            except OSError:
                pass  # the client has seen enough, as some tests want it to
            finally:
                server.under_way -= 1
                self.close_connection = True  # what was written may not be what was announced

        def log_message(self, *args: object) -> None:
            pass

    with serving(Handler) as address:
        server.url = address
        yield server
