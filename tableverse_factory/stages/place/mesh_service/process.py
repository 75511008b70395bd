"""A mesh model in a process of its own: started once, kept, and talked to in frames (docs/mesh-process.md)."""

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
"""Wall time until the process says hello [s]: interpreters, containers and their imports, but no weights."""
LOAD_S = 900.0
"""Wall time in which it loads its weights [s]."""
MAX_HEAD_BYTES = 64 * 1024
MAX_MESH_BYTES = 256 * 1024 * 1024
"""Of one mesh file; a longer one is not read."""

_END_S = 0.5
"""In which a process that has hung up is seen to have ended [s]."""
_LENGTH = struct.Struct("<I")
_BLOCK = 1 << 16
_SHOWN = 200
_PASSED = re.compile(
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
"""With a password most often, and what the process says is quoted in records and errors."""
_LOOK_S = 1.0
"""Between two looks at whether what is waited for is still wanted [s]."""
_LAUNCH = Path(__file__).with_name("launcher.py")


class ProcessFaultError(Exception):
    """The process died, fell silent, or sent what is no frame; it is of no use any more. In one line."""


@dataclass(frozen=True, slots=True)
class MeshFrame:
    """A message: its head, and the bytes that came with it."""

    head: Mapping[str, Any]
    parts: tuple[bytes, ...] = ()

    def packed(self) -> list[bytes]:
        """The pieces that are sent, or kept on disk."""
        head = json.dumps({**self.head, "parts": [len(part) for part in self.parts]}, allow_nan=False).encode()
        return [_LENGTH.pack(len(head)) + head, *self.parts]

    @classmethod
    def read(cls, data: bytes) -> "MeshFrame":
        """The message that `packed` made these bytes of."""
        (length,) = _LENGTH.unpack_from(data)
        head = json.loads(data[_LENGTH.size : _LENGTH.size + length])
        ends = list(accumulate(head["parts"], initial=_LENGTH.size + length))
        return cls(head, tuple(data[start:end] for start, end in pairwise(ends)))


@dataclass(frozen=True, slots=True)
class Hello:
    """Who answers.

    Attributes:
        model: Its name.
        version: Of code and weights; answers are kept under it.
        licence: Of the meshes, as the process says.
        wants: What else than picture and mask decides its answers: `depth`, `seed`.
    """

    model: str
    version: str
    licence: str
    wants: frozenset[str]


class MeshProcess:
    """One process, from its start to its end.

    Attributes:
        hello: Who answers.
    """

    def __init__(self, command: tuple[str, ...], stay: Callable[[], None] = lambda: None) -> None:
        """Starts it and waits for its hello.

        Args:
            command: Program and arguments.
            stay: Called every second of any wait; what it raises ends that.

        Raises:
            ModelAccessError: if it does not start, or speaks another protocol.
        """
        self._command, self._stay, self._loaded = command, stay, False
        self._below: list[psutil.Process] = []
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(_LAUNCH), str(os.getpid()), *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            bufsize=0,
            process_group=0,  # whoever kills our group leaves it the time to end what is below it
            env=environment(),
        )
        assert self._process.stdin is not None  # noqa: S101 for the type checker
        assert self._process.stdout is not None  # noqa: S101
        assert self._process.stderr is not None  # noqa: S101
        self._said = StderrTail(self._process.stderr)
        self._to, self._from = self._process.stdin.fileno(), self._process.stdout.fileno()
        os.set_blocking(self._to, False)
        self._ahead = bytearray()
        self.hello = self._begun("start", HELLO_S, _hello)

    @property
    def is_alive(self) -> bool:
        """Whether it runs."""
        return self._process.poll() is None

    def load(self) -> None:
        """Has the weights loaded, if they are not yet.

        Raises:
            ModelAccessError: if the process cannot.
        """
        if not self._loaded:
            self._begun("load", LOAD_S, _ready)
            self._loaded = True

    def send(self, frame: MeshFrame, within_s: float) -> None:
        """Sends a message.

        Raises:
            ProcessFaultError: if it is not taken.
        """
        until = time.monotonic() + within_s
        for piece in frame.packed():
            left = memoryview(piece)
            while left:
                self._wait(until, within_s, writing=True)
                try:
                    left = left[os.write(self._to, left[: 16 * _BLOCK]) :]
                except BlockingIOError:
                    continue
                except OSError as error:
                    raise ProcessFaultError(self._how_it_ended()) from error

    def receive(self, within_s: float) -> MeshFrame:
        """The next message, whole.

        Raises:
            ProcessFaultError: if it does not come in time, is too long, or is none.
        """
        until = time.monotonic() + within_s
        start = self._exactly(_LENGTH.size, until, within_s)
        (length,) = _LENGTH.unpack(start)
        if length > MAX_HEAD_BYTES:
            raise ProcessFaultError(
                f"its stdout holds {sanitize_line(repr(start))} where a message begins: what prints?"
            )
        try:
            head = json.loads(self._exactly(length, until, within_s))
        except (ValueError, RecursionError) as error:
            raise ProcessFaultError("it sent a message whose head is no JSON") from error
        return MeshFrame(head, tuple(self._exactly(size, until, within_s) for size in _sizes(head)))

    def close(self, patience_s: float = 0.0) -> None:
        """Ends the process and all that it started; it may end by itself within so long [s]."""
        assert self._process.stdin is not None  # noqa: S101
        assert self._process.stdout is not None  # noqa: S101
        self._note_descendants()
        self._process.stdin.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(patience_s)
        for process in self._below:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        self._process.kill()
        self._process.wait()
        self._process.stdout.close()

    def _begun(self, what: str, within_s: float, read: Any) -> Any:
        """What `read` makes of the process's answer to its start, or to being told to load."""
        try:
            if what == "load":
                self.send(MeshFrame({"type": "load"}), within_s)
            answer = read(self.receive(within_s).head)
            self._note_descendants()
            return answer
        except ProcessFaultError as fault:
            self.close()
            said = self.last_words()
            shown = sanitize_line(shlex.join(self._command), _SHOWN)
            raise ModelAccessError(
                f"the mesh process `{shown}` does not {what}: {fault}" + (f"; it says: {said}" if said else "")
            ) from None

    def _exactly(self, size: int, until: float, within_s: float) -> bytes:
        """The next bytes; what came with them stays for later."""
        while len(self._ahead) < size:
            self._wait(until, within_s, writing=False)
            block = os.read(self._from, max(_BLOCK, min(size - len(self._ahead), 1 << 20)))
            if not block:
                raise ProcessFaultError(self._how_it_ended())
            self._ahead += block
        data = bytes(memoryview(self._ahead)[:size])
        del self._ahead[:size]
        return data

    def _wait(self, until: float, within_s: float, *, writing: bool) -> None:
        """Waits until there is something to read, or room to write."""
        while (left := until - time.monotonic()) > 0.0:
            reads, writes = ([], [self._to]) if writing else ([self._from], [])
            if any(select.select(reads, writes, [], min(left, _LOOK_S))):
                return
            self._stay()
        raise ProcessFaultError(f"it was silent for {within_s:g} s")

    def _how_it_ended(self) -> str:
        try:
            code = self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            return "it closed its stdin or stdout"
        return f"it was killed by signal {-code}" if code < 0 else f"it ended with exit code {code}"

    def last_words(self) -> str:
        """The last line on its stderr; ask when it is closed."""
        return self._said.line()

    def _note_descendants(self) -> None:
        """Remembers what it has started: were the one that sees to their end killed, nobody would know them."""
        if self.is_alive:  # else its number may be another's by now
            with suppress(psutil.NoSuchProcess):
                self._below += psutil.Process(self._process.pid).children(recursive=True)


def environment() -> dict[str, str]:
    """What the process gets to know of ours: where programs, GPUs, weights and caches are, and nothing else."""
    known = {name: value for name, value in os.environ.items() if _PASSED.fullmatch(name)}
    return {name: value for name, value in known.items() if not _USER_IN_URL.search(value)}


def _sizes(head: Any) -> list[int]:
    """The lengths of the parts that follow a head."""
    sizes = head.get("parts", []) if isinstance(head, dict) else None
    if not isinstance(sizes, list) or len(sizes) > 1 or not all(type(size) is int and size >= 0 for size in sizes):
        raise ProcessFaultError("it sent a message that says not what follows it")
    if sizes and sizes[0] > MAX_MESH_BYTES:
        raise ProcessFaultError(f"it sent a mesh of {sizes[0]} bytes; at most {MAX_MESH_BYTES} are read")
    return sizes


def _hello(head: Mapping[str, Any]) -> Hello:
    if head.get("type") != "hello" or head.get("protocol") != PROTOCOL:
        raise ProcessFaultError(f"its first message is no hello of protocol {PROTOCOL}")
    words = [head.get(name) for name in ("model", "version", "licence")]
    wants = head.get("wants", [])
    if not all(isinstance(word, str) and 0 < len(word) <= 100 and word.isprintable() for word in words):
        raise ProcessFaultError("its hello must name model, version and licence, in 1 to 100 characters each")
    if not isinstance(wants, list) or not set(map(str, wants)) <= {"depth", "seed"}:
        raise ProcessFaultError("its hello may want 'depth' and 'seed'")
    model, version, licence = map(str, words)
    return Hello(model, version, licence, frozenset(map(str, wants)))


def _ready(head: Mapping[str, Any]) -> None:
    if head.get("type") != "ready":
        raise ProcessFaultError("it answered 'load' with something else than 'ready'")
