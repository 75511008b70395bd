"""Daemon that holds one model for all processes of a machine: started by the first client, ended after the last."""

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
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from tableverse_factory.core.errors import ModelAccessError, ModelError, WeightsError
from tableverse_factory.core.source_hash import compute_source_hash
from tableverse_factory.models.local.batch_server import BatchModel, Heartbeat, serve_batches
from tableverse_factory.models.local.fingerprint import stat_weights
from tableverse_factory.models.local.wire import WireError, decode_error, receive_arrays, send_arrays

Spec = dict[str, str | int]  # description of a model

START_S = 60.0  # limit until the daemon listens; it loads its weights after that [s]
TRIES = 2  # attempts at one question; a daemon that dies is started again
DYING_S = 0.5  # time in which a dying daemon closes its listening socket after its connections [s]
_POLL_S = 0.02
_MAX_FOLDER = 85  # maximum length of the folder's path; that of a socket may have 107 [bytes]
# Place of the log in messages, which go into datasets and must not hold paths of this machine.
_LOG = "a .log in the folder tableverse-UID of $XDG_RUNTIME_DIR, or of the temporary files where that is not set"
_ERRORS = {kind.__name__: kind for kind in (ModelAccessError, WeightsError)}
_CONNECTIONS: dict[Path, socket.socket] = {}


def ask_daemon(module: str, spec: Spec, question: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Ask the daemon of a model, which is started if none listens: `module`, which calls `run_daemon`.

    Equal specs share a daemon, on the same GPU.

    Raises:
        ModelAccessError: if a person must act before the model can be used.
        ModelError: if the model fails, or the daemon dies at every attempt.
    """
    path = compute_socket_path(module, spec)
    for _ in range(TRIES):
        try:
            end = _CONNECTIONS.get(path) or _CONNECTIONS.setdefault(path, _connect(path, module, spec))
            send_arrays(end, question)
            fine, *answer = receive_arrays(end)
        except BaseException as error:  # the next question must not get this one's answer
            close_connections(path)
            if not isinstance(error, WireError):
                raise
            time.sleep(DYING_S)
            continue
        if fine.tolist() == [1]:
            return answer
        kind, message = decode_error(answer[0])
        raise _ERRORS.get(kind, ModelError)(message)
    raise ModelError(f"the process of the model died {TRIES} times; its last words are in {_LOG}")


def close_connections(path: Path | None = None) -> None:
    """Close the connection to one daemon, or to all."""
    for key in [path] if path else list(_CONNECTIONS):
        if end := _CONNECTIONS.pop(key, None):
            end.close()


def run_daemon(configure: Callable[[Spec], tuple[int, Callable[[Heartbeat], BatchModel]]]) -> None:
    """Serve a model; to be called by a module that is run as `MODULE SOCKET SPEC`.

    `configure` returns the batch size for a description, and a function that makes the model.
    """
    path, spec = Path(sys.argv[1]), json.loads(sys.argv[2])
    listener = socket.socket(socket.AF_UNIX)
    listener.bind(str(path))
    listener.listen(256)
    most, make = configure(spec)
    serve_batches(listener, path, most, make)
    path.with_suffix(".log").unlink(missing_ok=True)


def compute_socket_path(module: str, spec: Spec) -> Path:
    """Compute the path of a daemon's socket from the model, its weights on disk, the GPU and this code."""
    weights, gpu = stat_weights(str(spec.get("weights", ""))), os.environ.get("CUDA_VISIBLE_DEVICES", "")
    code = (str(Path(__file__).resolve()), compute_source_hash(), sys.prefix)
    parts = [module, json.dumps(spec, sort_keys=True), weights, gpu, *code]
    name = hashlib.sha256("\0".join(parts).encode()).hexdigest()[:16]
    return _make_socket_folder() / f"{name}.sock"


def _make_socket_folder() -> Path:
    """Create a folder that only this user can enter, in `XDG_RUNTIME_DIR` or with the temporary files."""
    parents = [Path(name).absolute() for name in (os.environ.get("XDG_RUNTIME_DIR"), tempfile.gettempdir()) if name]
    candidates = [path / f"tableverse-{os.getuid()}" for path in parents if path.is_dir()]
    fitting = [path for path in candidates if len(os.fsencode(path)) <= _MAX_FOLDER]
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


def _connect(path: Path, module: str, spec: Spec) -> socket.socket:
    with contextlib.closing(path.with_name("lock").open("ab")) as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # only one process looks for a daemon and starts it
        if end := _try_connect(path):
            return end
        path.unlink(missing_ok=True)
        process = _start(path, module, spec)
        until = time.monotonic() + START_S
        while time.monotonic() < until and process.poll() is None:
            if end := _try_connect(path):
                return end
            time.sleep(_POLL_S)
    raise ModelError(f"the process of the model did not start; its last words are in {_LOG}")


def _try_connect(path: Path) -> socket.socket | None:
    end = socket.socket(socket.AF_UNIX)
    try:
        end.connect(str(path))
    except OSError:
        end.close()
        return None
    return end


def _start(path: Path, module: str, spec: Spec) -> "subprocess.Popen[bytes]":
    """Start the daemon in its own session: the sandbox that starts it may be killed, but it serves others too.

    It keeps the working directory, to which `PYTHONPATH` and caches may be relative.
    """
    command = [sys.executable, "-P", "-m", module, str(path), json.dumps(spec)]
    with path.with_suffix(".log").open("wb") as log:
        return subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log, start_new_session=True)
