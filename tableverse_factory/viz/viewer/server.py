"""The viewer as a server: a session per browser, and a clock for all of them."""

import socket
import warnings
from collections.abc import Sequence
from types import ModuleType
from typing import Any

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.optional_imports import require_extra
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.viz.viewer.clock import Clock
from tableverse_factory.viz.viewer.origin_check import OriginPolicy, wanted_scene
from tableverse_factory.viz.viewer.scene_cache import SceneCache
from tableverse_factory.viz.viewer.session import Session


def need_viser() -> ModuleType:
    """The package that draws in browsers.

    Raises:
        InputError: `no_extra` if it is not installed.
    """
    return require_extra("viser", "the viewer", "viewer")


class Viewer:
    """A running viewer.

    Attributes:
        url: Where to look at it.
    """

    def __init__(
        self,
        shelf: SceneCache,
        first: str | None,
        host: str,
        port: int,
        robot: str | None = None,
        allowed: Sequence[str] = (),
    ) -> None:
        """Starts it.

        Args:
            shelf: The scenes.
            first: The scene that a browser sees first which asks for no other.
            host: Address to listen on.
            port: 0 takes a free one.
            robot: The arm of motions whose robot comes from a file.
            allowed: Addresses of this server as browsers see it behind a proxy.

        Raises:
            InputError: `port_in_use`, `bad_host`, `bad_origin`, or `no_extra`.
        """
        viser = need_viser()
        self._door = OriginPolicy(host, allowed)
        _check_free(host, port)
        self._shelf, self._first, self._robot = shelf, first, robot
        self._sessions: dict[int, Session] = {}
        import rich

        rich.get_console().quiet = True  # viser tells there that it starts and stops
        # Somebody may close the page while its scene moves: what was on its way is lost, and nothing else.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        self._server: Any = viser.ViserServer(host=host, port=port, label="TableVerse", verbose=False)
        self._close_tunnel()
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self._server.get_port()}/"
        self._clock = Clock(self.sessions)
        self._server.on_client_connect(self._came)
        self._server.on_client_disconnect(self._went)

    def sessions(self) -> list[Session]:
        """Of the browsers that look."""
        return list(self._sessions.values())

    def stop(self) -> None:
        """Ends it and its threads."""
        self._clock.stop()
        self._server.stop()

    def _close_tunnel(self) -> None:
        """Takes away what would make a dataset public at a browser's word: viser can ask a server of its makers to."""
        from viser import _messages

        self._server._websock_server.unregister_handler(_messages.ShareUrlRequest)

    def _came(self, client: Any) -> None:
        """Lets a browser in that shows our own page, and shows it the scene that its address names."""
        connection = self._server._websock_server._live_connections.get(client.client_id)
        if connection is None:
            return  # gone already
        request = connection.request
        origin, asked = request.headers.get("Origin"), request.headers.get("Host")
        if not self._door.lets_in(origin, asked):
            self._server.get_event_loop().call_soon_threadsafe(lambda: connection.transport.abort())
            return
        linked = bool(asked) and self._shelf.has_links
        link = (lambda scene_id: self._door.link_to(scene_id, origin, asked)) if linked else lambda _: ""
        session = Session(client, self._shelf, self._robot, link, self._clock.wake)
        self._sessions[client.client_id] = session
        if client.client_id not in self._server.get_clients():  # gone while its controls were built
            self._sessions.pop(client.client_id, None)
            return
        session.open(wanted_scene(request.path) or self._first)

    async def _went(self, client: Any) -> None:  # at once, not in one of viser's threads
        self._sessions.pop(client.client_id, None)


def _check_free(host: str, port: int) -> None:
    """Whether one may listen there: viser would take the next port that is free, without a word."""
    where = sanitize_line(host, 100)
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        socket.create_server((host, port), family=family).close()
    except socket.gaierror as error:
        raise InputError(f"{where}: no address of this machine: {error.strerror}", "bad_host") from None
    except (OSError, OverflowError) as error:
        said = error.strerror if isinstance(error, OSError) else "no such port"
        raise InputError(
            f"cannot listen on {where} port {port}: {said}; give another with --port, or --port 0 for a free one",
            "port_in_use",
        ) from None
