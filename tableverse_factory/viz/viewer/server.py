"""The viewer as a web server: one session per browser, and one ticker for all of them."""

import asyncio
import logging
import socket
import threading
import warnings
from collections.abc import Awaitable, Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from types import ModuleType
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.optional_imports import import_extra
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.viz.viewer.origin_check import OriginPolicy, parse_scene_id
from tableverse_factory.viz.viewer.scene_cache import SceneCache
from tableverse_factory.viz.viewer.session import Session
from tableverse_factory.viz.viewer.ticker import Ticker

_Handler = Callable[[Any], Awaitable[None]]
_START_TIMEOUT_S = 30.0

# The HTTP request with which the browser of the current task opened its WebSocket.
_REQUEST: ContextVar[Any] = ContextVar("viewer_request", default=None)


def import_viser() -> ModuleType:
    """Import viser, which draws in browsers; raise `no_extra` if it is not installed."""
    return import_extra("viser", "the viewer", "viewer")


class Viewer:
    """A running viewer; `url` is the address of its page."""

    def __init__(
        self,
        scenes: SceneCache,
        first: str | None,
        host: str,
        port: int,
        robot: str | None = None,
        allowed: Sequence[str] = (),
    ) -> None:
        """Start the server; port 0 takes a free one, and browsers whose address names no scene see the `first`.

        `robot` is the arm of trajectories whose robot comes from a file; `allowed` is that of `OriginPolicy`.

        Raises:
            InputError: `port_in_use`, `bad_host`, `bad_origin`, or `no_extra`.
        """
        viser = import_viser()
        self._policy = OriginPolicy(host, allowed)
        _check_port(host, port)
        self._scenes, self._first, self._robot = scenes, first, robot
        self._sessions: dict[int, Session] = {}
        self._ready = threading.Event()
        import rich

        rich.get_console().quiet = True  # viser prints there when it starts and stops
        # A browser may leave while its scene moves; only the messages on their way to it are lost.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        logging.getLogger("websockets.server").addFilter(_is_own_error)
        with _wrap_websocket_handlers(self._guard):
            self._server: Any = _disable_sharing(viser)(host=host, port=port, label="TableVerse", verbose=False)
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self._server.get_port()}/"
        self._ticker = Ticker(self.sessions)
        self._server.on_client_connect(self._on_connect)
        self._server.on_client_disconnect(self._on_disconnect)
        self._ready.set()

    def sessions(self) -> list[Session]:
        """List the sessions of the connected browsers."""
        return list(self._sessions.values())

    def stop(self) -> None:
        """Stop the server and its threads."""
        self._ticker.stop()
        self._server.stop()

    async def _guard(self, connection: Any, handler: _Handler) -> None:
        """Close the WebSocket of any page but ours; keep the request for `_on_connect`."""
        headers = connection.request.headers
        if self._policy.allows(headers.get("Origin"), headers.get("Host")):
            await asyncio.to_thread(self._ready.wait, _START_TIMEOUT_S)
            _REQUEST.set(connection.request)
            await handler(connection)
        else:
            await connection.close(1008, "origin not allowed")

    async def _on_connect(self, client: Any) -> None:
        request = _REQUEST.get()
        if request is not None:  # every connection that passed `_guard` has one
            await asyncio.to_thread(self._start_session, client, request)

    def _start_session(self, client: Any, request: Any) -> None:
        """Build the controls of a browser and show it the scene that its address names."""
        origin, host = request.headers.get("Origin"), request.headers.get("Host")
        linked = bool(host) and self._scenes.has_links
        link = (lambda scene_id: self._policy.make_link(scene_id, origin, host)) if linked else lambda _: ""
        session = Session(client, self._scenes, self._robot, link, self._ticker.wake)
        self._sessions[client.client_id] = session
        if client.client_id not in self._server.get_clients():  # it left while its controls were built
            self._sessions.pop(client.client_id, None)
            return
        session.open(parse_scene_id(request.path) or self._first)

    async def _on_disconnect(self, client: Any) -> None:
        self._sessions.pop(client.client_id, None)


def _disable_sharing(viser: ModuleType) -> Any:
    """Make a server class that never opens viser's public tunnel, which any browser could request."""

    class LocalServer(viser.ViserServer):  # type: ignore[misc, name-defined]
        def request_share_url(self, verbose: bool = True) -> None:  # noqa: ARG002
            return None

    return LocalServer


@contextmanager
def _wrap_websocket_handlers(guard: Callable[[Any, _Handler], Awaitable[None]]) -> Iterator[None]:
    """Pass every WebSocket of a server that starts in this block to `guard` before its own handler.

    viser has no hook that sees the headers of a connection; the `websockets` server that it starts has.
    """
    import websockets.asyncio.server as websocket_server

    serve = websocket_server.serve

    def serve_guarded(handler: _Handler, *args: Any, **options: Any) -> Any:
        async def handle(connection: Any) -> None:
            await guard(connection, handler)

        return serve(handle, *args, **options)

    websocket_server.serve = serve_guarded  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        websocket_server.serve = serve  # type: ignore[misc]


def _is_own_error(record: logging.LogRecord) -> bool:
    """Whether a message of the web server is not about a request that is none, such as HEAD or a scan of ports."""
    from websockets.exceptions import InvalidHandshake

    return record.exc_info is None or not isinstance(record.exc_info[1], InvalidHandshake)


def _check_port(host: str, port: int) -> None:
    """Check that the port is free: viser would silently take the next one."""
    where = sanitize_line(host, 100)
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        socket.create_server((host, port), family=family).close()
    except socket.gaierror as error:
        raise InputError(f"{where}: no address of this machine: {error.strerror}", "bad_host") from None
    except (OSError, OverflowError) as error:
        reason = error.strerror if isinstance(error, OSError) else "no such port"
        raise InputError(
            f"cannot listen on {where} port {port}: {reason}; give another with --port, or --port 0 for a free one",
            "port_in_use",
        ) from None
