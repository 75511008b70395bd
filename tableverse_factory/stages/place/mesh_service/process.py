"""Mesh model in a process of its own, which is asked over HTTP (docs/mesh-process.md)."""

import asyncio
import os
import re
import shlex
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Annotated, Any, Literal

import psutil
from pydantic import AfterValidator, BaseModel, Field, ValidationError

from schemas.address import is_loopback
from tableverse_factory.core.errors import ModelAccessError, ModelError
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.models.remote.endpoint import Endpoint
from tableverse_factory.models.remote.http import BoundedClient, send_with_retries
from tableverse_factory.models.remote.http_errors import format_host

PROTOCOL = 2
HELLO_S = 120.0  # limit until the process says hello: interpreters, containers and imports, but no weights [s]
LOAD_S = 900.0  # limit for loading weights [s]
MAX_ANSWER_BYTES = 352 * 1024 * 1024  # meshes of 256 MiB and a little more, in base64; longer answers are not read
MAX_BATCH = 32  # maximum number of objects in one request

_END_S = 1.0  # time in which a process that closed its connection ends [s]
_OUTPUT_S = 0.5  # time in which the output of a process that ended is read [s]
_MAX_LINE = 1 << 16
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
_USER_IN_URL = re.compile(r"://\S*@")  # often with a password, and records and errors quote what the process says
_POLL_S = 1.0  # interval of the heartbeat during waits [s]
_LAUNCH = Path(__file__).with_name("launcher.py")


class ProcessFaultError(Exception):
    """Fault of a process that died, fell silent or sent an invalid answer, in one line."""


def _check_printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("has characters that cannot be printed")
    return text


def _check_loopback(url: str) -> str:
    if not url.startswith("http://") or not is_loopback(url):
        raise ValueError("is no http:// address of this machine")
    return url


_Name = Annotated[str, Field(min_length=1, max_length=100), AfterValidator(_check_printable)]


class Hello(BaseModel, frozen=True):
    """Line of JSON with which a process says that it listens.

    Attributes:
        version: Version of code and weights; part of the cache key.
        wants: Further inputs of the model besides picture and mask.
        batch: Number of objects that it makes at a time.
    """

    protocol: Literal[2]
    url: Annotated[str, Field(max_length=200), AfterValidator(_check_loopback)]
    model: _Name
    version: _Name
    licence: _Name
    wants: frozenset[Literal["depth", "seed"]] = frozenset()
    batch: Annotated[int, Field(ge=1, le=MAX_BATCH)] = 1

    def describe_model(self) -> dict[str, Any]:
        """Return what determines meshes, as JSON for answers and the cache."""
        return {"model": self.model, "version": self.version, "licence": self.licence, "wants": sorted(self.wants)}


class ProcessOutput:
    """Output of a process, read in a thread so that it never blocks.

    Attributes:
        hello: First line that begins with a brace; empty if there is none yet.
        is_settled: Set when `hello` is known, or the output has ended without one.
    """

    def __init__(self, pipe: IO[bytes]) -> None:
        self.hello, self.is_settled = b"", threading.Event()
        self._pipe, self._last = pipe, ""
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        with self._pipe:
            while line := self._pipe.readline(_MAX_LINE):
                if not self.hello and line.startswith(b"{"):
                    self.hello = line
                    self.is_settled.set()
                elif shown := [text for text in line.decode(errors="replace").splitlines() if text.strip()]:
                    self._last = shown[-1]
        self.is_settled.set()

    def read_last_line(self) -> str:
        """Return the last line besides the hello; it is complete when the process has ended."""
        self._thread.join(_OUTPUT_S)
        return sanitize_line(self._last.strip(), _SHOWN)


class MeshProcess:
    """A mesh process and its hello; `heartbeat` is called every second of any wait, which an exception of it ends."""

    def __init__(self, command: tuple[str, ...], heartbeat: Callable[[], None] = lambda: None) -> None:
        """Start the process and wait for its hello.

        Raises:
            ModelAccessError: if the process does not start, or speaks another protocol.
        """
        self._command, self._heartbeat, self._loaded = command, heartbeat, False
        self._descendants: list[psutil.Process] = []
        self._process = subprocess.Popen(
            [sys.executable, "-I", "-S", str(_LAUNCH), str(os.getpid()), *command],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            process_group=0,  # killing our group leaves the launcher time to end its descendants
            env=select_environment(),
        )
        assert self._process.stdin is not None  # noqa: S101 for the type checker
        assert self._process.stdout is not None  # noqa: S101
        self._stdin, self.output = self._process.stdin, ProcessOutput(self._process.stdout)
        self.hello = self._require("start", self._await_hello)

    @property
    def is_alive(self) -> bool:
        """Whether the process runs."""
        return self._process.poll() is None

    def load(self) -> None:
        """Let the process load its weights, unless it has, or raise ModelAccessError."""
        if not self._loaded:
            self._require("load", lambda: self.post_question({"pictures": [], "objects": []}, LOAD_S))
            self._loaded = True

    def post_question(self, question: Mapping[str, Any], within_s: float) -> Mapping[str, Any]:
        """Post objects and return the process's answer.

        Raises:
            ProcessFaultError: if it does not come in time, is too long, or is no JSON object.
        """
        url, model = self.hello.url, self.hello.model
        endpoint = Endpoint(
            "meshes", url, model, timeout_s=within_s, read_s=within_s, max_body_bytes=MAX_ANSWER_BYTES, attempts=1
        )

        async def send(client: BoundedClient) -> Mapping[str, Any]:
            post = asyncio.ensure_future(client.post(f"{url.rstrip('/')}/meshes", json=question))
            try:
                while not (await asyncio.wait([post], timeout=_POLL_S))[0]:
                    self._heartbeat()
                return post.result().json()
            finally:
                post.cancel()

        until = time.monotonic() + within_s
        try:
            return send_with_retries(endpoint, send, {}, until)
        except ModelError as error:
            if time.monotonic() >= until:
                raise ProcessFaultError(f"it was silent for {within_s:g} s") from error
            host = format_host(endpoint.base_url)  # the port is another each time, and records quote the message
            problem = str(error).replace(f"{host}: ", "").replace(host, "it")
            raise ProcessFaultError(self._describe_exit() or problem) from error

    def close(self, grace_s: float = 0.0) -> None:
        """End the process and its descendants; it has `grace_s` to end by itself."""
        self._note_descendants()
        self._stdin.close()
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(grace_s)
        for process in self._descendants:
            with suppress(psutil.NoSuchProcess):
                process.kill()
        self._process.kill()
        self._process.wait()

    def _await_hello(self) -> Hello:
        until = time.monotonic() + HELLO_S
        while not self.output.is_settled.wait(max(0.0, min(_POLL_S, until - time.monotonic()))):
            if time.monotonic() >= until:
                raise ProcessFaultError(f"it was silent for {HELLO_S:g} s")
            self._heartbeat()
        if not self.output.hello:
            raise ProcessFaultError(self._describe_exit() or "it closed its output without a hello")
        try:
            return Hello.model_validate_json(self.output.hello)
        except ValidationError as error:
            first = error.errors()[0]
            problem = sanitize_line(f"{'.'.join(map(str, first['loc']))}: {first['msg']}", _SHOWN)
            raise ProcessFaultError(f"its first message is no hello of protocol {PROTOCOL}: {problem}") from None

    def _require(self, step: str, attempt: Callable[[], Any]) -> Any:
        """Do what must succeed before meshes can be made, or end the process."""
        try:
            result = attempt()
            self._note_descendants()
            return result
        except ProcessFaultError as fault:
            self.close()
            line = self.output.read_last_line()
            shown = sanitize_line(shlex.join(self._command), _SHOWN)
            raise ModelAccessError(
                f"the mesh process `{shown}` does not {step}: {fault}" + (f"; it says: {line}" if line else "")
            ) from None

    def _describe_exit(self) -> str:
        """Describe how the process ended; empty if it runs."""
        try:
            code = self._process.wait(_END_S)
        except subprocess.TimeoutExpired:
            return ""
        return f"it was killed by signal {-code}" if code < 0 else f"it ended with exit code {code}"

    def _note_descendants(self) -> None:
        """Note the descendants of the launcher, to end them should it be killed."""
        if self.is_alive:  # else its pid may be another's by now
            with suppress(psutil.NoSuchProcess):
                self._descendants += psutil.Process(self._process.pid).children(recursive=True)


def select_environment() -> dict[str, str]:
    """Select the variables that the process may see: where programs, GPUs, weights and caches are."""
    known = {name: value for name, value in os.environ.items() if _PASSED_VARIABLES.fullmatch(name)}
    return {name: value for name, value in known.items() if not _USER_IN_URL.search(value)}
