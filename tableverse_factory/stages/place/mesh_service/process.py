"""Mesh model in a process of its own, with which frames are exchanged (docs/mesh-process.md)."""

import json
import os
import re
import select
import shlex
import struct
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from itertools import accumulate, pairwise
from pathlib import Path
from typing import Any

import psutil

from tableverse_factory.core.errors import ModelAccessError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.stages.place.mesh_service.stderr_tail import StderrTail

PROTOCOL = 1
HELLO_S = 120.0
"""Limit until the process says hello: interpreters, containers and imports, but no weights [s]."""
LOAD_S = 900.0
"""Limit for loading weights [s]."""
MAX_HEAD_BYTES = 64 * 1024
MAX_MESH_BYTES = 256 * 1024 * 1024
"""Maximum size of a mesh file; longer ones are not read."""

_END_S = 0.5
"""Time in which a process that closed its pipes ends [s]."""
_LENGTH = struct.Struct("<I")
_BLOCK = 1 << 16
_SHOWN = 200
_PASSED_VARIABLES = re.compile(
    "PATH|HOME|USER|LOGNAME|SHELL|TMPDIR|TZ|LANG|LANGUAGE|LC_(ALL|COLLATE|CTYPE|MESSAGES|MONETARY|NUMERIC|TIME)"
    "|LD_LIBRARY_PATH|XDG_(CACHE_HOME|CONFIG_HOME|DATA_HOME|RUNTIME_DIR)|(OMP|MKL|OPENBLAS|NUMEXPR)_NUM_THREADS"
    "|SSL_CERT_(FILE|DIR)|REQUESTS_CA_BUNDLE|DOCKER_HOST"
    "|CUDA_(VISIBLE_DEVICES|DEVICE_ORDER|HOME|PATH|CACHE_PATH|LAUNCH_BLOCKING|MODULE_LOADING)"
    "|CUDA_MPS_(PIPE|LOG)_DIRECTORY|CUBLAS_WORKSPACE_CONFIG|(ROCR|HIP)_VISIBLE_DEVICES"
    "|NVIDIA_(VISIBLE_DEVICES|DRIVER_CAPABILITIES|TF32_OVERRIDE)"
    "|TORCH_(HOME|EXTENSIONS_DIR|CUDA_ARCH_LIST)|PYTORCH_(ALLOC_CONF|CUDA_ALLOC_CONF)"
    "|HF_(HOME|HUB_CACHE|HUB_OFFLINE|ENDPOINT)|TRANSFORMERS_(CACHE|OFFLINE)"
    "|CONDA_(EXE|PREFIX|DEFAULT_ENV|ENVS_PATH|PKGS_DIRS)|MAMBA_(EXE|ROOT_PREFIX)"
    "|(APPTAINER|SINGULARITY)_(BIND|CACHEDIR|TMPDIR)"
)
_USER_IN_URL = re.compile(r"://\S*@")
"""Most often with a password, and messages of the process are quoted in records and errors."""
_POLL_S = 1.0
"""Interval of the heartbeat during waits [s]."""
_LAUNCH = Path(__file__).with_name("launcher.py")


class ProcessFaultError(Exception):
    """Fault of a process that died, fell silent or sent an invalid message, in one line."""


@dataclass(frozen=True, slots=True)
class MeshFrame:
    """A message: JSON head and binary parts."""

    head: Mapping[str, Any]
    parts: tuple[bytes, ...] = ()

    def encode_parts(self) -> list[bytes]:
        """Encode the frame as a list of byte strings, to be sent or stored."""
        head = json.dumps({**self.head, "parts": [len(part) for part in self.parts]}, allow_nan=False).encode()
        return [_LENGTH.pack(len(head)) + head, *self.parts]

    @classmethod
    def decode(cls, data: bytes) -> "MeshFrame":
        """Decode a trusted frame."""
        (length,) = _LENGTH.unpack_from(data)
        head = json.loads(data[_LENGTH.size : _LENGTH.size + length])
        ends = list(accumulate(head["parts"], initial=_LENGTH.size + length))
        return cls(head, tuple(data[start:end] for start, end in pairwise(ends)))


@dataclass(frozen=True, slots=True)
class Hello:
    """First message of a process.

    Attributes:
        model: Name of the model.
        version: Version of code and weights; part of the cache key.
        licence: Licence of the meshes.
        wants: Further inputs of the model besides picture and mask: `depth`, `seed`.
    """

    model: str
    version: str
    licence: str
    wants: frozenset[str]


class MeshProcess:
    """A running mesh process.

    Attributes:
        hello: First message of the process.
    """

    def __init__(self, command: tuple[str, ...], heartbeat: Callable[[], None] = lambda: None) -> None:
        """Start the process and wait for its hello.

        Args:
            command: Program and arguments.
            heartbeat: Called every second of any wait, which an exception ends.

        Raises:
            ModelAccessError: if the process does not start, or speaks another protocol.
        """
        self._command, self._heartbeat, self._loaded = command, heartbeat, False
        self._descendants: list[psutil.Process] = []
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(_LAUNCH), str(os.getpid()), *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            process_group=0,  # killing our group leaves the launcher time to end its descendants
            env=select_environment(),
        )
        assert self._process.stdin is not None  # noqa: S101 for the type checker
        assert self._process.stdout is not None  # noqa: S101
        assert self._process.stderr is not None  # noqa: S101
        self._stderr = StderrTail(self._process.stderr)
        self._to, self._from = self._process.stdin.fileno(), self._process.stdout.fileno()
        os.set_blocking(self._to, False)
        self._ahead = bytearray()
        self.hello = self._await_answer("start", HELLO_S, _parse_hello)

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def load(self) -> None:
        """Let the process load its weights, unless it has.

        Raises:
            ModelAccessError: if it cannot.
        """
        if not self._loaded:
            self._await_answer("load", LOAD_S, _check_ready)
            self._loaded = True

    def send(self, frame: MeshFrame, within_s: float) -> None:
        """Send a message.

        Raises:
            ProcessFaultError: if the process does not read it.
        """
        until = time.monotonic() + within_s
        for piece in frame.encode_parts():
            left = memoryview(piece)
            while left:
                self._wait(until, within_s, writing=True)
                try:
                    left = left[os.write(self._to, left[: 16 * _BLOCK]) :]
                except BlockingIOError:
                    continue
                except OSError as error:
                    raise ProcessFaultError(self._describe_exit()) from error

    def receive(self, within_s: float) -> MeshFrame:
        """Receive the next message.

        Raises:
            ProcessFaultError: if it does not come in time, is too long, or is invalid.
        """
        until = time.monotonic() + within_s
        start = self._receive_exactly(_LENGTH.size, until, within_s)
        (length,) = _LENGTH.unpack(start)
        if length > MAX_HEAD_BYTES:
            raise ProcessFaultError(
                f"its stdout holds {sanitize_line(repr(start))} where a message begins: what prints?"
            )
        try:
            head = json.loads(self._receive_exactly(length, until, within_s))
        except (ValueError, RecursionError) as error:
            raise ProcessFaultError("it sent a message whose head is no JSON") from error
        return MeshFrame(head, tuple(self._receive_exactly(size, until, within_s) for size in _parse_sizes(head)))

    def close(self, grace_s: float = 0.0) -> None:
        """End the process and its descendants; it has `grace_s` to end by itself."""
        assert self._process.stdin is not None  # noqa: S101
        assert self._process.stdout is not None  # noqa: S101
        self._note_descendants()
        self._process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(grace_s)
        for process in self._descendants:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()

    def _await_answer(self, step: str, within_s: float, read: Any) -> Any:
        """Parse the answer of the process to its start, or to the message to load."""
        try:
            if step == "load":
                self.send(MeshFrame({"type": "load"}), within_s)
            answer = read(self.receive(within_s).head)
            self._note_descendants()
            return answer
        except ProcessFaultError as fault:
            self.close()
            line = self.read_last_line()
            shown = sanitize_line(shlex.join(self._command), _SHOWN)
            raise ModelAccessError(
                f"the mesh process `{shown}` does not {step}: {fault}" + (f"; it says: {line}" if line else "")
            ) from None

    def _receive_exactly(self, size: int, until: float, within_s: float) -> bytes:
        """Receive exactly so many bytes; further ones stay in the buffer."""
        while len(self._ahead) < size:
            self._wait(until, within_s, writing=False)
            block = os.read(self._from, max(_BLOCK, min(size - len(self._ahead), 1 << 20)))
            if not block:
                raise ProcessFaultError(self._describe_exit())
            self._ahead += block
        data = bytes(memoryview(self._ahead)[:size])
        del self._ahead[:size]
        return data

    def _wait(self, until: float, within_s: float, *, writing: bool) -> None:
        while (left := until - time.monotonic()) > 0.0:
            reads, writes = ([], [self._to]) if writing else ([self._from], [])
            if any(select.select(reads, writes, [], min(left, _POLL_S))):
                return
            self._heartbeat()
        raise ProcessFaultError(f"it was silent for {within_s:g} s")

    def _describe_exit(self) -> str:
        try:
            code = self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            return "it closed its stdin or stdout"
        return f"it was killed by signal {-code}" if code < 0 else f"it ended with exit code {code}"

    def read_last_line(self) -> str:
        """Return the last line on stderr; call it after `close`."""
        return self._stderr.read_last_line()

    def _note_descendants(self) -> None:
        """Note the descendants of the launcher, to end them should it be killed."""
        if self.is_alive:  # else its pid may be another's by now
            with suppress(psutil.NoSuchProcess):
                self._descendants += psutil.Process(self._process.pid).children(recursive=True)


def select_environment() -> dict[str, str]:
    """Select the variables that the process may see: where programs, GPUs, weights and caches are."""
    known = {name: value for name, value in os.environ.items() if _PASSED_VARIABLES.fullmatch(name)}
    return {name: value for name, value in known.items() if not _USER_IN_URL.search(value)}


def _parse_sizes(head: Any) -> list[int]:
    sizes = head.get("parts", []) if isinstance(head, dict) else None
    if not isinstance(sizes, list) or len(sizes) > 1 or not all(type(size) is int and size >= 0 for size in sizes):
        raise ProcessFaultError("it sent a message that says not what follows it")
    if sizes and sizes[0] > MAX_MESH_BYTES:
        raise ProcessFaultError(f"it sent a mesh of {sizes[0]} bytes; at most {MAX_MESH_BYTES} are read")
    return sizes


def _parse_hello(head: Mapping[str, Any]) -> Hello:
    if head.get("type") != "hello" or head.get("protocol") != PROTOCOL:
        raise ProcessFaultError(f"its first message is no hello of protocol {PROTOCOL}")
    fields = [head.get(name) for name in ("model", "version", "licence")]
    wants = head.get("wants", [])
    if not all(isinstance(text, str) and 0 < len(text) <= 100 and text.isprintable() for text in fields):
        raise ProcessFaultError("its hello must name model, version and licence, in 1 to 100 characters each")
    if not isinstance(wants, list) or not set(map(str, wants)) <= {"depth", "seed"}:
        raise ProcessFaultError("its hello may want 'depth' and 'seed'")
    model, version, licence = map(str, fields)
    return Hello(model, version, licence, frozenset(map(str, wants)))


def _check_ready(head: Mapping[str, Any]) -> None:
    if head.get("type") != "ready":
        raise ProcessFaultError("it answered 'load' with something else than 'ready'")
