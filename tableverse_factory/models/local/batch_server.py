"""Server of a process that holds one model and answers all connections, several questions in one batch."""

import select
import selectors
import socket
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from tableverse_factory.core.errors import ModelAccessError, ModelError
from tableverse_factory.models.local.batches import get_first_line, is_cuda_failure, is_out_of_memory
from tableverse_factory.models.local.weights import create_memory_error, release_models
from tableverse_factory.models.local.wire import WireError, encode_error, receive_arrays, send_arrays

Arrays = Sequence[np.ndarray]
BatchModel = Callable[[Sequence[Arrays]], Iterable[Arrays]]  # answers in order, each sent as soon as it is yielded
Heartbeat = Callable[[], None]  # for long work, every second or so: SystemExit when no client is connected any more

GATHER_S = 0.005  # wait for further questions of a batch that is not full, a twentieth of a forward pass [s]
IDLE_S = 15.0  # time without connections after which the process ends [s]
REFUSING_S = 1.0  # the same for a process without a model, so that the next one may succeed [s]
MESSAGE_S = 5.0  # limit for a message that has begun, in either direction: all others wait meanwhile [s]
ACCEPTED, REFUSED = np.array([1], dtype=np.uint8), np.array([0], dtype=np.uint8)


def serve_batches(
    listener: socket.socket, path: Path, most: int, make: Callable[[Heartbeat], BatchModel], idle_s: float = IDLE_S
) -> None:
    """Answer questions until no client has been connected for a while.

    Clients may connect and ask before `make` has made the model. If it cannot be made, each is told why, and the
    process ends. `listener` is bound to the socket file `path`, which is removed at the end; a batch holds at most
    `most` questions.
    """
    queue = _ConnectionQueue(listener, idle_s)
    try:
        try:
            model = make(queue.check_clients)
        except Exception as error:  # noqa: BLE001 whatever it is, waiting clients must be told
            traceback.print_exc()
            model = _refuse_all(create_memory_error(error) if is_out_of_memory(error) else error)
            queue.idle_s = REFUSING_S
        while batch := queue.gather(most):
            for connection, arrays in _answer_batch(model, batch):
                queue.send(connection, arrays)
    except SystemExit:
        return
    finally:
        path.unlink(missing_ok=True)
        queue.close()
        release_models()


def _refuse_all(error: Exception) -> BatchModel:
    def refuse(questions: Sequence[Arrays]) -> Sequence[Arrays]:  # noqa: ARG001
        raise error

    return refuse


def _answer_batch(model: BatchModel, batch: dict[socket.socket, Arrays]) -> Iterator[tuple[socket.socket, Arrays]]:
    """Answer a batch; if it fails, each question alone, so that none is refused for its neighbour.

    An error of CUDA itself is raised: the GPU is lost for this process, which has to end.
    """
    left = dict(batch)
    try:
        for connection, own in zip(batch, model(list(batch.values())), strict=True):
            yield connection, [ACCEPTED, *own]
            del left[connection]
        return
    except Exception as error:  # a question of one client must not end the process of all
        if is_cuda_failure(error):
            raise
        # An error that a person must resolve holds for all questions.
        refusal = _encode_refusal(error) if len(batch) == 1 or isinstance(error, ModelAccessError) else None
        if refusal is not None and not isinstance(error, ModelError):
            traceback.print_exc()
    for connection, question in left.items():
        if refusal is not None:
            yield connection, [REFUSED, refusal]
        else:
            yield from _answer_batch(model, {connection: question})


def _encode_refusal(error: Exception) -> np.ndarray:
    """Encode an error for the client: a `ModelAccessError` as such, all others as a `ModelError`."""
    if isinstance(error, ModelError):
        return encode_error(type(error).__name__, str(error))
    return encode_error(ModelError.__name__, f"the model failed: {type(error).__name__}: {get_first_line(error)}")


class _ConnectionQueue:
    def __init__(self, listener: socket.socket, idle_s: float) -> None:
        self._listener, self.idle_s = listener, idle_s
        self._selector = selectors.DefaultSelector()
        self._selector.register(listener, selectors.EVENT_READ)
        self._last_client_s = time.monotonic()

    def gather(self, most: int) -> dict[socket.socket, Arrays]:
        """Receive the next questions, at most `most`; none if no client has been connected for a while."""
        batch: dict[socket.socket, Arrays] = {}
        until = float("inf")
        while len(batch) < most and (left := until - time.monotonic()) > 0:
            ready = self._selector.select(min(left, 1.0))
            for key, _ in ready[:]:
                connection = key.fileobj
                if connection is self._listener:
                    self._selector.register(self._listener.accept()[0], selectors.EVENT_READ)
                elif isinstance(connection, socket.socket) and len(batch) < most:
                    self._receive(connection, batch)
            if not batch:  # whoever asked may have hung up since
                until = float("inf")
            elif until == float("inf"):
                until = time.monotonic() + GATHER_S
            if not batch and self._is_idle():
                break
        return batch

    def send(self, connection: socket.socket, arrays: Arrays) -> None:
        """Send an answer, or drop the connection if its client is gone."""
        try:
            connection.settimeout(MESSAGE_S)
            send_arrays(connection, arrays)
        except (WireError, OSError):
            self._drop(connection)

    def check_clients(self) -> None:
        """See `Heartbeat`."""
        if self._is_idle():
            raise SystemExit

    def close(self) -> None:
        for key in list(self._selector.get_map().values()):
            if isinstance(key.fileobj, socket.socket):
                key.fileobj.close()
        self._selector.close()

    def _receive(self, connection: socket.socket, batch: dict[socket.socket, Arrays]) -> None:
        try:
            batch[connection] = receive_arrays(connection, MESSAGE_S)
        except WireError:
            batch.pop(connection, None)
            self._drop(connection)

    def _drop(self, connection: socket.socket) -> None:
        if connection.fileno() >= 0:  # it may have been dropped while its question was answered
            self._selector.unregister(connection)
            connection.close()

    def _is_idle(self) -> bool:
        """Whether no client has been connected, or waiting to connect, for a while."""
        keys, poll = list(self._selector.get_map().values()), select.poll()
        for key in keys:
            poll.register(key.fd, select.POLLIN if key.fileobj is self._listener else select.POLLRDHUP)
        events = dict(poll.poll(0))  # of the listener: a client connects; of the others: the client is gone
        now = time.monotonic()
        if any((key.fd in events) == (key.fileobj is self._listener) for key in keys):
            self._last_client_s = now
        return now - self._last_client_s > self.idle_s
