"""Server of a Python policy for `tableverse benchmark run --policy http://127.0.0.1:PORT`.

from tableverse_factory.evaluation.benchmark.policy_server import serve_policy
from my_policy import MyPolicy
serve_policy(MyPolicy, port=8000)
"""

import json
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from tableverse_factory.evaluation.benchmark.json_arrays import MAX_MESSAGE_BYTES, decode_array, decode_start
from tableverse_factory.evaluation.benchmark.policy import Policy, check_policy
from tableverse_factory.evaluation.benchmark.policy_failure import describe_failure

MAX_SESSIONS = 256  # the session that was asked longest ago is forgotten
_IDLE_S = 600.0


class PolicyServer(ThreadingHTTPServer):
    """HTTP server on the loopback interface, with an instance of the policy per session."""

    daemon_threads = True

    def __init__(self, make: Callable[[], Policy], port: int) -> None:
        super().__init__(("127.0.0.1", port), _Handler)
        self._make, self._lock = make, threading.Lock()
        self._sessions: OrderedDict[str, tuple[Policy, threading.Lock]] = OrderedDict()
        self._first: Policy | None = check_policy(make(), getattr(make, "__name__", "made by the given function"))
        self.description = {"pictures": list(self._first.pictures), "picture_size": list(self._first.picture_size)}

    def answer(self, path: str, message: Mapping[str, Any]) -> dict[str, Any]:
        """Answer one message (`http_policy`)."""
        if path == "/describe":
            return self.description
        policy, lock = self._open(str(message["session"]))
        with lock:
            if path == "/reset":
                policy.reset(decode_start(message["start"]))
                return {}
            seen = {str(name): decode_array(value) for name, value in message["observation"].items()}
            return {"action": [float(value) for value in policy.act(seen)]}

    def _open(self, session: str) -> tuple[Policy, threading.Lock]:
        with self._lock:
            if session not in self._sessions:
                policy, self._first = self._first or self._make(), None
                self._sessions[session] = policy, threading.Lock()
                if len(self._sessions) > MAX_SESSIONS:
                    self._sessions.popitem(last=False)
            self._sessions.move_to_end(session)
            return self._sessions[session]


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    disable_nagle_algorithm = True
    timeout = _IDLE_S
    server: PolicyServer

    def do_POST(self) -> None:
        """Answer a message of the benchmark."""
        try:
            length = int(self.headers.get("Content-Length", ""))
            if self.headers.get_content_type() != "application/json":  # which no page of a browser sends unasked
                raise ValueError("the content is not application/json")
            if not 0 <= length <= MAX_MESSAGE_BYTES or self.path not in ("/describe", "/reset", "/act"):
                raise ValueError(f"{self.path[:40]} with {length} bytes")
            message = json.loads(self.rfile.read(length))
            status, answer = 200, self.server.answer(self.path, message)
        except Exception as error:  # noqa: BLE001 whatever the policy raises is told to the benchmark
            status, answer = 500, {"error": describe_failure(error, 200)}
            self.close_connection = True
        body = json.dumps(answer).encode()
        self.send_response(status)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 the name is that of the base class
        """Stay silent: there are hundreds of messages in an episode."""


def serve_policy(make: Callable[[], Policy], port: int = 8000) -> None:
    """Serve a policy on 127.0.0.1 until Ctrl-C; `make` makes an instance per process of the benchmark."""
    with suppress(KeyboardInterrupt), PolicyServer(make, port) as server:  # also while the policy is made
        server.serve_forever()
