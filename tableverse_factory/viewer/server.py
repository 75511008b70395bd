"""The viewer as a server: a session per browser, one thread that lets time pass while somebody looks."""

import socket
import threading
import time
import warnings
from types import ModuleType
from typing import Any

from tableverse_factory.errors import InputError
from tableverse_factory.text import printable
from tableverse_factory.viewer.door import link_to, trusted, wanted_scene
from tableverse_factory.viewer.session import Session
from tableverse_factory.viewer.shelf import Shelf

TICK_S = 1 / 30
_BUSY_SHARE = 0.7
"""Of a tick that physics may take, all browsers together."""

_LONGEST_S = 0.2
"""More time than this never passes at once: after a stall things go on, they do not jump."""


def need_viser() -> ModuleType:
    """The package that draws in browsers.

    Raises:
        InputError: `no_viser` if it is not installed.
    """
    try:
        import viser
    except ImportError:
        raise InputError("the viewer needs viser: pip install 'tableverse-factory[viewer]'", "no_viser") from None
    module: ModuleType = viser
    return module


class Viewer:
    """A running viewer.

    Attributes:
        url: Where to look at it.
    """

    def __init__(self, shelf: Shelf, first: str | None, host: str, port: int, robot: str | None = None) -> None:
        """Starts it.

        Args:
            shelf: The scenes.
            first: The scene that a browser sees first which asks for no other.
            host: Address to listen on.
            port: 0 takes a free one.
            robot: The arm of motions whose robot comes from a file.

        Raises:
            InputError: `port_in_use`, `bad_host`, or `no_viser`.
        """
        viser = need_viser()
        _check_free(host, port)
        self._shelf, self._first, self._host, self._robot = shelf, first, host, robot
        self._sessions: dict[int, Session] = {}
        self._changed = threading.Condition()
        self._stopped = False
        import rich

        rich.get_console().quiet = True  # viser tells there that it starts and stops
        # Somebody may close the page while its scene moves: what was on its way is lost, and nothing else.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection")
        self._server: Any = viser.ViserServer(host=host, port=port, label="TableVerse", verbose=False)
        self._close_tunnel()
        shown = f"[{host}]" if ":" in host else host
        self.url = f"http://{shown}:{self._server.get_port()}/"
        self._server.on_client_connect(self._came)
        self._server.on_client_disconnect(self._went)
        self._ticker = threading.Thread(target=self._tick, name="viewer-ticker", daemon=True)
        self._ticker.start()

    def sessions(self) -> list[Session]:
        """Of the browsers that look."""
        return list(self._sessions.values())

    def stop(self) -> None:
        """Ends it and its threads."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._ticker.join()
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
        asked = request.headers.get("Host")
        if not trusted(request.headers.get("Origin"), asked, self._host):
            self._server.get_event_loop().call_soon_threadsafe(lambda: connection.transport.abort())
            return
        link = (lambda scene_id: link_to(scene_id, asked)) if asked and self._shelf.has_links else lambda _: ""
        session = Session(client, self._shelf, self._robot, link, self._wake)
        self._sessions[client.client_id] = session
        if client.client_id not in self._server.get_clients():  # gone while its controls were built
            self._sessions.pop(client.client_id, None)
            return
        session.open(wanted_scene(request.path) or self._first)

    async def _went(self, client: Any) -> None:  # at once, not in one of viser's threads
        self._sessions.pop(client.client_id, None)

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _playing(self) -> list[Session]:
        return [session for session in self.sessions() if session.playing]

    def _tick(self) -> None:
        last = time.perf_counter()
        while not self._stopped:
            playing = self._playing()
            if not playing:
                with self._changed:
                    self._changed.wait_for(lambda: self._stopped or self._playing(), timeout=None)
                last = time.perf_counter()
                continue
            now = time.perf_counter()
            passed, last = min(now - last, _LONGEST_S), now
            for session in playing:
                session.tick(passed, _BUSY_SHARE * TICK_S / len(playing))
            time.sleep(max(0.0, now + TICK_S - time.perf_counter()))


def _check_free(host: str, port: int) -> None:
    """Whether one may listen there: viser would take the next port that is free, without a word."""
    where = printable(host, 100)
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
