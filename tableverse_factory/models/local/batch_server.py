"""A process that holds one model and answers all who ask, several in one forward."""

import select
import selectors
import socket
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from tableverse_factory.core.errors import ModelAccessError, ModelError
from tableverse_factory.models.local.batches import first_line, is_broken, is_out_of_memory
from tableverse_factory.models.local.weights import does_not_fit, release
from tableverse_factory.models.local.wire import WireError, receive, send, words

Arrays = Sequence[np.ndarray]
Answer = Callable[[Sequence[Arrays]], Iterable[Arrays]]
"""Of a batch, in its order; what comes one by one is given one by one."""
Heartbeat = Callable[[], None]
"""For what takes long, every second or so: raises SystemExit where nobody has been there for a while to hear of it."""

GATHER_S = 0.005
"""How long a batch that is not full waits for more: a forward takes twenty times as long [s]."""
IDLE_S = 15.0
"""Without anyone connected the process ends: its askers are gone for good, or it is told again where they are [s]."""
REFUSING_S = 1.0
"""The same where there is no model: what was wrong may be right by the next time [s]."""
SLOW_S = 5.0
"""For the whole of a message that has begun, either way: meanwhile all others wait [s]."""
FINE, REFUSED = np.array([1], dtype=np.uint8), np.array([0], dtype=np.uint8)


def serve(
    listener: socket.socket, path: Path, most: int, make: Callable[[Heartbeat], Answer], idle_s: float = IDLE_S
) -> None:
    """Answers until nobody is connected any more.

    The socket is there before the model is: who asks meanwhile waits. Where the model cannot be made, everyone is told
    why, and the process ends.

    Args:
        listener: Bound to `path` and listening.
        path: Removed at the end.
        most: Questions in one call of the answer.
        make: Makes the model; the answer to each batch, in its order.
        idle_s: See `IDLE_S` [s].
    """
    desk = _ConnectionQueue(listener, idle_s)
    try:
        try:
            answer = make(desk.stay)
        except Exception as error:  # noqa: BLE001 whatever it is, those who wait must hear of it
            traceback.print_exc()
            answer = _refusing(does_not_fit(error) if is_out_of_memory(error) else error)
            desk.idle_s = REFUSING_S
        while batch := desk.gather(most):
            for end, arrays in _answered(answer, batch):
                desk.give(end, arrays)
    except SystemExit:
        return
    finally:
        path.unlink(missing_ok=True)
        desk.close()
        release()


def _refusing(error: Exception) -> Answer:
    def refuse(questions: Sequence[Arrays]) -> Sequence[Arrays]:  # noqa: ARG001
        raise error

    return refuse


def _answered(answer: Answer, batch: dict[socket.socket, Arrays]) -> Iterator[tuple[socket.socket, Arrays]]:
    """The answers; where a batch fails, of each question alone, so that none is refused for its neighbour.

    Raises:
        RuntimeError: where the GPU is lost for this process, which has to end: the next one may have it again.
    """
    left = dict(batch)
    try:
        for end, own in zip(batch, answer(list(batch.values())), strict=True):
            yield end, [FINE, *own]
            del left[end]
        return
    except Exception as error:  # a question of one asker must not end the process of all
        if is_broken(error):
            raise
        # What a person must see to holds for all.
        refusal = _refusal(error) if len(batch) == 1 or isinstance(error, ModelAccessError) else None
        if refusal is not None and not isinstance(error, ModelError):
            traceback.print_exc()
    for end, question in left.items():
        if refusal is not None:
            yield end, [REFUSED, refusal]
        else:
            yield from _answered(answer, {end: question})


def _refusal(error: Exception) -> np.ndarray:
    """What an asker is told: a `ModelAccessError` as such, everything else as a `ModelError`."""
    if isinstance(error, ModelError):
        return words(type(error).__name__, str(error))
    return words(ModelError.__name__, f"the model failed: {type(error).__name__}: {first_line(error)}")


class _ConnectionQueue:
    """Who is connected, and who has asked."""

    def __init__(self, listener: socket.socket, idle_s: float) -> None:
        self._listener, self.idle_s = listener, idle_s
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ)
        self._left_at = time.monotonic()

    def gather(self, most: int) -> dict[socket.socket, Arrays]:
        """The next questions, at most so many; none where nobody has been connected for a while."""
        batch: dict[socket.socket, Arrays] = {}
        until = float("inf")
        while len(batch) < most and (left := until - time.monotonic()) > 0:
            ready = self._selector.select(min(left, 1.0))
            for key, _ in ready[:]:
                end = key.fileobj
                if end is self._listener:
                    self._welcome()
                elif isinstance(end, socket.socket) and len(batch) < most:
                    self._hear(end, batch)
            if batch and until == float("inf"):
                until = time.monotonic() + GATHER_S
            if not batch and self._is_alone():
                break
        return batch

    def give(self, end: socket.socket, arrays: Arrays) -> None:
        """Sends an answer; who is gone is forgotten."""
        try:
            end.settimeout(SLOW_S)
            send(end, arrays)
        except (WireError, OSError):
            self._forget(end)

    def stay(self) -> None:
        """See `Heartbeat`."""
        if self._is_alone():
            raise SystemExit

    def close(self) -> None:
        """Hangs up."""
        for key in list(self._selector.get_map().values()):
            if isinstance(key.fileobj, socket.socket):
                key.fileobj.close()
        self._selector.close()

    def _welcome(self) -> None:
        end, _ = self._listener.accept()
        self._selector.register(end, selectors.EVENT_READ)

    def _hear(self, end: socket.socket, batch: dict[socket.socket, Arrays]) -> None:
        try:
            batch[end] = receive(end, SLOW_S)
        except WireError:
            batch.pop(end, None)
            self._forget(end)

    def _forget(self, end: socket.socket) -> None:
        if end.fileno() >= 0:  # it may have been forgotten while its question was worked on
            self._selector.unregister(end)
            end.close()

    def _is_alone(self) -> bool:
        """Whether nobody has been connected, or waiting to be, for a while."""
        keys, ends = list(self._selector.get_map().values()), select.poll()
        for key in keys:
            ends.register(key.fd, select.POLLIN if key.fileobj is self._listener else select.POLLRDHUP)
        heard = dict(ends.poll(0))  # of the listener: somebody comes; of the others: the other end is gone
        now = time.monotonic()
        if any((key.fd in heard) == (key.fileobj is self._listener) for key in keys):
            self._left_at = now
        return now - self._left_at > self.idle_s
