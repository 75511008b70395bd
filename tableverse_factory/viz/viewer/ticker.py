"""The thread that advances playback in all browsers."""

import logging
import threading
import time
from collections.abc import Callable, Sequence

from tableverse_factory.viz.viewer.session import Session

TICK_S = 1 / 30
_BUSY_SHARE = 0.7  # share of a tick that physics may take, all browsers together

_LONGEST_S = 0.2  # longest time that a tick advances: after a stall, playback continues without a jump

_log = logging.getLogger(__name__)


class Ticker:
    """A thread that ticks the sessions that play, and sleeps while none does."""

    def __init__(self, sessions: Callable[[], Sequence[Session]]) -> None:
        self._sessions = sessions
        self._changed = threading.Condition()
        self._stopped = False
        self._thread = threading.Thread(target=self._run, name="viewer-ticker", daemon=True)
        self._thread.start()

    def wake(self) -> None:
        """Continue after a session has begun to play."""
        with self._changed:
            self._changed.notify_all()

    def stop(self) -> None:
        """Stop the thread and wait for it."""
        with self._changed:
            self._stopped = True
            self._changed.notify_all()
        self._thread.join()

    def _list_playing(self) -> list[Session]:
        return [session for session in self._sessions() if session.playing]

    def _run(self) -> None:
        last = time.perf_counter()
        while not self._stopped:
            playing = self._list_playing()
            if not playing:
                with self._changed:
                    self._changed.wait_for(lambda: self._stopped or self._list_playing(), timeout=None)
                last = time.perf_counter()
                continue
            now = time.perf_counter()
            passed, last = min(now - last, _LONGEST_S), now
            for session in playing:
                _tick(session, passed, _BUSY_SHARE * TICK_S / len(playing))
            time.sleep(max(0.0, now + TICK_S - time.perf_counter()))


def _tick(session: Session, seconds: float, budget_s: float) -> None:
    try:
        session.tick(seconds, budget_s)
    except Exception:  # noqa: BLE001 - a failing session must not stop the others
        _log.exception("a browser of the viewer missed a tick")
