"""Builds as jobs of a Ray cluster: submit, follow, stop."""

import asyncio
import logging
import os
import re
import shlex
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tableverse_factory.core.errors import BuildError
from tableverse_factory.core.storage.files import redact_uri
from workers.executors.ray_address import name_address_source, reject_secrets
from workers.sandbox.error_text import sanitize_error_text

OUT_KEY = "tableverse_out"  # key of OUT in a job's metadata
ADDRESS_HINT = "the head's port for jobs, e.g. http://head:8265"
STOPPED_CODE = 143
STOP_TIMEOUT_S = 60.0
UNREACHABLE_S = 300.0  # longest outage of the cluster while a job is followed [s]
_POLL_S = 1.0
_MAX_TRIES = 20
_SLUG_CHARS = 40


class JobServer:
    """Client of the jobs of one cluster, through the HTTP port of its head."""

    def __init__(self, address: str) -> None:
        """Connect to `address`, e.g. `http://head:8265`."""
        self.address = _parse_url(address)
        try:
            with self._translate_errors():
                self._client = _make_client(self.address)
        except BuildError as error:
            if not isinstance(error.__cause__, ConnectionError):
                raise
            raise BuildError(f"{error}; give {ADDRESS_HINT}") from error

    def submit(self, out: str, command: Sequence[str], runtime_env: Mapping[str, Any]) -> str:
        """Submit a build of `out`; returns the job's id."""
        if running := self.find_running(out):
            raise BuildError(
                f"{out} is being built by job {running} on {self.address}: give --stop to end it, or follow it with "
                f"ray job logs --follow --address {self.address} {running}"
            )
        with self._translate_errors():
            for _ in range(_MAX_TRIES):
                job = make_job_id(out, (str(job.submission_id) for job in self._client.list_jobs()))
                try:
                    return str(
                        self._client.submit_job(
                            entrypoint=shlex.join(command),
                            submission_id=job,
                            runtime_env=dict(runtime_env),
                            metadata={OUT_KEY: out},
                        )
                    )
                except RuntimeError as error:
                    if "already exists" not in str(error):  # taken meanwhile: try the next number
                        raise
        raise BuildError(f"no free job id for {out} on {self.address} after {_MAX_TRIES} tries")

    def find_running(self, out: str) -> str | None:
        """Find the id of the job that builds `out` now, or None."""
        with self._translate_errors():
            jobs = self._client.list_jobs()
        alive = (job for job in jobs if (job.metadata or {}).get(OUT_KEY) == out and not job.status.is_terminal())
        return next((str(job.submission_id) for job in alive), None)

    def follow(self, job: str, write: Callable[[str], object]) -> int:
        """Pass the job's log to `write` as it grows, until the job ends; returns the exit code of its command."""
        log, last_answer = IncrementalLog(write), time.monotonic()
        while True:
            try:
                asyncio.run(self._tail(job, log))
                details = self._client.get_job_info(job)
                last_answer = time.monotonic()
            except (OSError, RuntimeError) as error:  # requests' and aiohttp's are among them
                if time.monotonic() - last_answer > UNREACHABLE_S:
                    text = sanitize_error_text(str(error))
                    raise BuildError(f"{self.address} cannot be reached any more: {text}") from error
            else:
                if details.status.is_terminal():
                    return get_exit_code(str(details.status), details.driver_exit_code)
            time.sleep(_POLL_S)

    def stop(self, out: str) -> str | None:
        """Stop the job that builds `out` and wait for its end; returns its id, or None if there is none."""
        job = self.find_running(out)
        if job is None:
            return None
        with self._translate_errors():
            self._client.stop_job(job)
            until = time.monotonic() + STOP_TIMEOUT_S
            while not self._client.get_job_info(job).status.is_terminal():
                if time.monotonic() > until:
                    raise BuildError(
                        f"job {job} did not end within {STOP_TIMEOUT_S:g} s: look at it with `ray job status`"
                    )
                time.sleep(_POLL_S / 4)
        return job

    async def _tail(self, job: str, log: "IncrementalLog") -> None:
        log.begin()
        async for text in self._client.tail_job_logs(job):
            log.write(text)

    @contextmanager
    def _translate_errors(self) -> Iterator[None]:
        """Translate errors of the client into one line."""
        try:
            yield
        except (OSError, RuntimeError, ValueError) as error:
            text = sanitize_error_text(str(error))[:600]
            raise BuildError(f"the jobs of {self.address} cannot be used: {text}") from error


class IncrementalLog:
    """Log that is written once, though Ray sends it from its beginning at every connection."""

    def __init__(self, write: Callable[[str], object]) -> None:
        self._write = write
        self._written = self._received = 0

    def begin(self) -> None:
        """Start a new connection."""
        self._received = 0

    def write(self, text: str) -> None:
        """Write the part of `text` that was not written before."""
        self._received += len(text)
        if (new := self._received - self._written) > 0:
            self._write(text[-new:])
            self._written = self._received


def make_job_id(out: str, taken: Iterable[str]) -> str:
    """Make an id `tableverse-<out>-<n>` with an unused n: Ray refuses an id that was ever used."""
    slug = re.sub(r"[^a-z0-9]+", "-", out.lower()).strip("-")[-_SLUG_CHARS:].strip("-")
    pattern = re.compile(rf"tableverse-{re.escape(slug)}-(\d+)")
    numbers = [int(match[1]) for job in taken if (match := pattern.fullmatch(job))]
    return f"tableverse-{slug}-{max(numbers, default=0) + 1}"


def get_exit_code(status: str, code: int | None) -> int:
    """Return the exit code for the status of a finished job."""
    if status == "SUCCEEDED":
        return 0
    if status == "STOPPED":
        return STOPPED_CODE
    if code is None or code == 0:
        return 1
    return code if code > 0 else 128 - code


def _parse_url(address: str) -> str:
    source = name_address_source(address, "RAY_API_SERVER_ADDRESS")
    reject_secrets(address, source, ADDRESS_HINT)
    url = address if "://" in address else f"http://{address}"
    if not re.fullmatch(r"https?://[^/\s]+(/[^\s]*)?", url):
        raise BuildError(f"{source} {redact_uri(address)}: give {ADDRESS_HINT}")
    return url.rstrip("/")


def _make_client(address: str) -> Any:
    """Create Ray's client, which prefers the address and token of the environment to its arguments."""
    if find_spec("aiohttp") is None:
        raise BuildError("submitting needs Ray's job client: pip install 'tableverse-factory[cluster]'")
    os.environ["RAY_API_SERVER_ADDRESS"] = address
    given = os.environ.get("RAY_AUTH_TOKEN") or os.environ.get("RAY_AUTH_TOKEN_PATH")
    if given or (Path.home() / ".ray" / "auth_token").is_file():
        os.environ.setdefault("RAY_AUTH_MODE", "token")  # read when ray is imported, so before it
    import ray.exceptions
    from ray.job_submission import JobSubmissionClient

    logging.getLogger("ray.dashboard.modules.job.sdk").setLevel(logging.WARNING)
    try:
        return JobSubmissionClient(address)
    except ray.exceptions.AuthenticationError:
        raise BuildError(
            f"{address} asks for a token, and has refused the one given or none was: write the cluster's into a file "
            "that only you can read and name that in RAY_AUTH_TOKEN_PATH (with RAY_AUTH_MODE=token)"
        ) from None
