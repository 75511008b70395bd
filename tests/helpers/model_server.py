"""A real HTTP server on this machine that answers as it is told to, for tests of everything that asks models."""

import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from typing import Any

from tests.helpers.loopback import serving


@dataclass
class Scripted:
    """An answer: JSON or bytes, or a function that writes to the socket itself."""

    body: Any = b""
    status: int = 200
    headers: dict[str, str] = field(default_factory=dict)
    write: Callable[[BaseHTTPRequestHandler], None] | None = None


@dataclass
class ModelServer:
    """Its address, what it was asked so far, and what it will say next: the last answer again and again."""

    url: str
    answers: list[Scripted] = field(default_factory=list)
    asked: list[dict[str, Any]] = field(default_factory=list)
    paths: list[str] = field(default_factory=list)
    headers: list[dict[str, str]] = field(default_factory=list)
    on_ask: Callable[[dict[str, Any]], Scripted] | None = None

    def say(self, *answers: Scripted) -> None:
        self.answers[:] = answers
        self.asked.clear()


@contextmanager
def model_server() -> Iterator[ModelServer]:
    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            question = json.loads(self.rfile.read(int(self.headers["content-length"])))
            server.asked.append(question)
            server.paths.append(self.path)
            server.headers.append({name.lower(): value for name, value in self.headers.items()})
            if server.on_ask is not None:
                answer = server.on_ask(question)
            else:
                answer = server.answers.pop(0) if len(server.answers) > 1 else server.answers[0]
            if answer.write is not None:
                answer.write(self)
                return
            body = answer.body if isinstance(answer.body, bytes) else json.dumps(answer.body).encode()
            self.send_response(answer.status)
            for name, value in {"Content-Length": str(len(body)), **answer.headers}.items():
                self.send_header(name, value)
            self.end_headers()
            self.wfile.write(body)

        def handle_one_request(self) -> None:
            try:
                super().handle_one_request()
            except OSError:  # the client hung up, as some tests want it to
                self.close_connection = True

        def log_message(self, *args: object) -> None:
            pass

    server = ModelServer("")
    with serving(Handler) as address:
        server.url = f"{address}/v1"
        yield server


def chat(text: str, **more: Any) -> Scripted:
    """A chat completion with this text."""
    choice = {"index": 0, "message": {"role": "assistant", "content": text}, "finish_reason": "stop", **more}
    return Scripted({"choices": [choice], "usage": {"prompt_tokens": 900, "completion_tokens": 40}})


def gemini(text: str, **more: Any) -> Scripted:
    """A generateContent answer with this text."""
    candidate = {"content": {"role": "model", "parts": [{"text": text}]}, "finishReason": "STOP", **more}
    counts = {"promptTokenCount": 700, "candidatesTokenCount": 30, "thoughtsTokenCount": 12}
    return Scripted({"candidates": [candidate], "usageMetadata": counts})
