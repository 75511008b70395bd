"""Serialization of the actions of one browser's session; errors are shown in that browser only."""

import logging
import threading
from collections.abc import Callable
from typing import Any

from tableverse_factory.core.errors import TableverseError
from tableverse_factory.core.text import sanitize_line

Action = Callable[[], None]

_log = logging.getLogger(__name__)


class SessionLock:
    """Runs the actions of one session one by one; they arrive in threads of viser and of the ticker."""

    def __init__(self, client: Any, halt: Action) -> None:
        """Wrap a `viser.ClientHandle`, which shows errors; `halt` stops playback after one."""
        self._client, self._halt = client, halt
        self._lock = threading.RLock()

    def run(self, action: Action) -> None:
        """Run an action as soon as no other one runs."""
        with self._lock:
            self._run(action)

    def try_run(self, action: Action) -> None:
        """Run an action unless another one runs."""
        if self._lock.acquire(blocking=False):
            try:
                self._run(action)
            finally:
                self._lock.release()

    def make_callback(self, action: Action) -> Callable[[Any], None]:
        """Make a callback for a control that runs an action on events of the browser, not of this program.

        At most one call of it waits and then finds the newest value: all browsers share the threads of viser, which a
        dragged slider would fill.
        """
        waiting = threading.Lock()

        def answer(event: Any) -> None:
            if event.client is None or not waiting.acquire(blocking=False):
                return
            with self._lock:
                waiting.release()
                self._run(action)

        return answer

    def _run(self, action: Action) -> None:
        try:
            action()
        except Exception as error:  # noqa: BLE001 - any error is shown and logged, and affects this browser only
            self._halt()
            message = sanitize_line(str(error), 500)
            if not isinstance(error, TableverseError | OSError):
                _log.exception("an action of the viewer failed")
                message = f"Internal error ({type(error).__name__}); the terminal of the viewer shows more."
            self._client.add_notification("This does not work", message, color="red", auto_close_seconds=20.0)
