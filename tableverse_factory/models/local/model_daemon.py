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
from tableverse_factory.core.errors import ModelAccessError, ModelError
from tableverse_factory.core.source_hash import source_hash
from tableverse_factory.models.local.batch_server import Answer, Heartbeat, serve
from tableverse_factory.models.local.fingerprint import stamp
from tableverse_factory.models.local.wire import WireError, read_words, receive, send

Spec = dict[str, str | int]
"""Which model, in words and numbers."""

START_S = 60.0
"""Until the process listens; its weights are read after that [s]."""
TRIES = 2
"""A process that dies is started once more for the same question."""
DYING_S = 0.5
"""A process that dies closes its connections before the socket that others connect to [s]."""
_POLL_S = 0.02
_MAX_FOLDER = 85
"""Of our folder's path [bytes]: a socket's own may have 107."""
_LOG = "a .log in the folder tableverse-UID of $XDG_RUNTIME_DIR, or of the temporary files where that is not set"
"""Where a process says what went wrong; the path itself is another on each machine, and messages go into datasets."""
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
        except BaseException as error:  # whatever it is: the next question must not get this one's answer
            hang_up(path)
            if not isinstance(error, WireError):
                raise
            time.sleep(DYING_S)
            continue
        if fine.tolist() == [1]:
            return answer
        kind, message = read_words(answer[0])
        raise ModelAccessError(message) if kind == ModelAccessError.__name__ else ModelError(message)
    raise ModelError(f"the process of the model died {TRIES} times; its last words are in {_LOG}")


def hang_up(path: Path | None = None) -> None:
    """Closes the connection to a process, or to all of them."""
    for key in [path] if path else list(_OPEN):
        if end := _OPEN.pop(key, None):
            end.close()


def main(make: Callable[[Spec], tuple[int, Callable[[Heartbeat], Answer]]]) -> None:
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
    path.with_suffix(".log").unlink(missing_ok=True)


def _address(module: str, spec: Spec) -> Path:
    """Where the process listens: one for each model, its weights as they are now, each GPU and this code."""
    gpu = os.environ.get("CUDA_VISIBLE_DEVICES", "")
    parts = [
        module,
        json.dumps(spec, sort_keys=True),
        stamp(str(spec.get("weights", ""))),
        gpu,
        str(Path(tableverse_factory.__file__).resolve()),
        source_hash(),
        sys.prefix,
    ]
    name = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
    return _folder() / f"{name}.sock"


def _folder() -> Path:
    """A folder that only this user can enter: in `XDG_RUNTIME_DIR` where that is one, else with the temporary files.

    Raises:
        ModelAccessError: if somebody else made it, or none can be made.
    """
    above = [Path(given).absolute() for given in (os.environ.get("XDG_RUNTIME_DIR"), tempfile.gettempdir()) if given]
    ours = [path / f"tableverse-{os.getuid()}" for path in above if path.is_dir()]
    fitting = [path for path in ours if len(os.fsencode(path)) <= _MAX_FOLDER]
    if not fitting:
        raise ModelAccessError(
            f"the process of a model needs a folder whose path has at most {_MAX_FOLDER} bytes: set XDG_RUNTIME_DIR"
        )
    folder = fitting[0]
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
    except OSError as error:
        raise ModelAccessError(f"{folder} cannot be made: {error.strerror}; set XDG_RUNTIME_DIR to another") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise ModelAccessError(
            f"{folder} is not a folder of this user alone: remove it, or set XDG_RUNTIME_DIR to another"
        )
    return folder


def _connected(path: Path, module: str, spec: Spec) -> socket.socket:
    """A connection to the process, which is started where nobody listens.

    Raises:
        ModelError: if it does not come.
    """
    with _alone(path.with_name("lock")):
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
    raise ModelError(f"the process of the model did not start; its last words are in {_LOG}")


def _knocked(path: Path) -> socket.socket | None:
    end = socket.socket(socket.AF_UNIX)
    try:
        end.connect(str(path))
    except OSError:
        end.close()
        return None
    return end


def _started(path: Path, module: str, spec: Spec) -> "subprocess.Popen[bytes]":
    """In a session of its own: the sandbox that starts it may be killed, and others ask it, too.

    It stays in the asker's folder, for `PYTHONPATH` and caches may be named from there.
    """
    command = [sys.executable, "-P", "-m", module, str(path), json.dumps(spec)]
    with path.with_suffix(".log").open("wb") as log:
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)


@contextmanager
def _alone(path: Path) -> Iterator[None]:
    """While one looks for a process or starts it, others wait."""
    with contextlib.closing(path.open("ab")) as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
