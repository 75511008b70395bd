"""One process for one model on a machine: started by the first who asks, asked by all, gone after the last."""

import contextlib
import fcntl
import hashlib
import json
import os
import socket
import stat
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

import tableverse_factory
from tableverse_factory.errors import ModelAccessError, ModelError
from tableverse_factory.neural.serving import Answer, serve
from tableverse_factory.neural.wire import WireError, read_words, receive, send

Spec = dict[str, str | int]
"""Which model, in words and numbers."""

START_S = 60.0
"""Until the process listens; its weights are read after that [s]."""
TRIES = 2
"""A process that dies is started once more for the same question."""
_POLL_S = 0.02
_OPEN: dict[Path, socket.socket] = {}


def ask(module: str, spec: Spec, question: Sequence[np.ndarray]) -> list[np.ndarray]:
    """The answer of the process that holds this model.

    Args:
        module: Run as the process where there is none yet; it calls `main`.
        spec: Which model, for `main`; equal ones share a process, on the same GPU.
        question: Arrays that the model understands.

    Raises:
        ModelAccessError: if the model cannot be had before a person acts.
        ModelError: if it gives no answer, or its process dies again and again.
    """
    path = _address(module, spec)
    for _ in range(TRIES):
        try:
            end = _OPEN.get(path) or _OPEN.setdefault(path, _connected(path, module, spec))
            send(end, question)
            fine, *answer = receive(end)
        except WireError:
            hang_up(path)
            continue
        if fine.tolist() == [1]:
            return answer
        kind, message = read_words(answer[0])
        raise ModelAccessError(message) if kind == ModelAccessError.__name__ else ModelError(message)
    raise ModelError(f"the process of the model died {TRIES} times; its last words are in {path.with_suffix('.log')}")


def hang_up(path: Path | None = None) -> None:
    """Closes the connection to a process, or to all of them."""
    for key in [path] if path else list(_OPEN):
        if end := _OPEN.pop(key, None):
            end.close()


def main(make: Callable[[Spec], tuple[int, Callable[[], Answer]]]) -> None:
    """What a process of a model does: `MODULE SOCKET SPEC`.

    Args:
        make: From the spec the most questions in one batch, and what makes the model.
    """
    path, spec = Path(sys.argv[1]), json.loads(sys.argv[2])
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen(256)
    most, made = make(spec)
    serve(listener, path, most, made)


def _address(module: str, spec: Spec) -> Path:
    """Where the process listens: one for each model, each GPU and each copy of this code."""
    gpu = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    parts = [
        module,
        json.dumps(spec, sort_keys=True),
        gpu,
        str(Path(tableverse_factory.__file__).resolve()),
        sys.prefix,
    ]
    name = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]
    return _folder() / f"{name}.sock"


def _folder() -> Path:
    """A folder that only this user can enter.

    Raises:
        ModelError: if somebody else made it.
    """
    folder = Path(os.environ.get("XDG_RUNTIME_DIR") or tempfile.gettempdir()) / f"tableverse-{os.getuid()}"
    folder.mkdir(mode=0o700, exist_ok=True)
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise ModelError(f"{folder} is not a folder of this user alone: remove it, or set XDG_RUNTIME_DIR to another")
    return folder


def _connected(path: Path, module: str, spec: Spec) -> socket.socket:
    """A connection to the process, which is started where nobody listens.

    Raises:
        ModelError: if it does not come.
    """
    with _alone(path.with_suffix(".lock")):
        end = _knocked(path)
        if end is not None:
            return end
        path.unlink(missing_ok=True)
        process = _started(path, module, spec)
        until = time.monotonic() + START_S
        while time.monotonic() < until and process.poll() is None:
            end = _knocked(path)
            if end is not None:
                return end
            time.sleep(_POLL_S)
    raise ModelError(f"the process of the model did not start; its last words are in {path.with_suffix('.log')}")


def _knocked(path: Path) -> socket.socket | None:
    end = socket.socket(socket.AF_UNIX)
    try:
        end.connect(str(path))
    except OSError:
        end.close()
        return None
    return end


def _started(path: Path, module: str, spec: Spec) -> "subprocess.Popen[bytes]":
    """In a session of its own: the sandbox that starts it may be killed, and others ask it, too."""
    command = [sys.executable, "-P", "-m", module, str(path), json.dumps(spec)]
    with path.with_suffix(".log").open("wb") as log:
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True, cwd=path.parent
        )


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """While one looks for the process or starts it, others wait."""
    with contextlib.closing(path.open("ab")) as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
