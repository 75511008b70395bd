"""One thing at a time in one browser's session; what goes wrong there is told there, and costs no other browser."""

import logging
import threading
from collections.abc import Callable
from typing import Any

from tableverse_factory.core.errors import TableverseError
from tableverse_factory.core.text import sanitize_line

Act = Callable[[], None]

_log = logging.getLogger(__name__)


class Turns:
    """Acts of one session, which arrive in threads of viser's and of the clock."""

    def __init__(self, client: Any, halt: Act) -> None:
        """Nothing is done yet.

        Args:
            client: A `viser.ClientHandle`, which is told what goes wrong.
            halt: Ends what plays when something went wrong.
        """
        self._client, self._halt = client, halt
        self._lock = threading.RLock()

    def take(self, act: Act) -> None:
        """Does it as soon as nothing else is done."""
        with self._lock:
            self._do(act)

    def take_if_free(self, act: Act) -> None:
        """Does it if nothing else is done."""
        if self._lock.acquire(blocking=False):
            try:
                self._do(act)
            finally:
                self._lock.release()

    def of_control(self, act: Act) -> Callable[[Any], None]:
        """A callback for a control: what the browser did counts, what this program writes into a control does not.

        One callback of a control waits at most, and finds the newest value: viser's threads are shared by all browsers,
        and a slider that is dragged would fill them.
        """
        waiting = threading.Lock()

        def answer(event: Any) -> None:
            if event.client is None or not waiting.acquire(blocking=False):
                return
            with self._lock:
                waiting.release()
                self._do(act)

        return answer

    def _do(self, act: Act) -> None:
        try:
            act()
        except Exception as error:  # noqa: BLE001 - whatever it is, it costs this browser alone; it is told and logged
            self._halt()
            said = sanitize_line(str(error), 500)
            if not isinstance(error, TableverseError | OSError):
                _log.exception("the viewer made a mistake")
                said = f"The viewer made a mistake ({type(error).__name__}); the terminal that it runs in says more."
            self._client.add_notification("This does not work", said, color="red", auto_close_seconds=20.0)
