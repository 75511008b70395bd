"""Policy behind an HTTP address of this machine: JSON out, JSON in.

    POST /describe  {}                                        -> {"pictures": [], "picture_size": [96, 128]}
    POST /reset     {"session": "…", "start": {…}}            -> {}
    POST /act       {"session": "…", "observation": {…}}      -> {"action": [0.1, …]}

`json_arrays` says how arrays are written. A session is one process of the benchmark: its episodes come one after the
other. Any other status than 200 is a failure of the policy, with `{"error": "…"}` as its reason.
"""

import http.client
import json
import secrets
import socket
from collections.abc import Mapping
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from schemas.address import is_loopback
from tableverse_factory.core.errors import ConfigError, InputError
from tableverse_factory.core.text import describe_error, sanitize_line
from tableverse_factory.evaluation.benchmark.json_arrays import encode_array, encode_start
from tableverse_factory.evaluation.benchmark.policy import EpisodeStart, PolicyError, PolicyGoneError, check_policy

ANSWER_S = 60.0  # time limit of an answer [s]
MAX_ANSWER_BYTES = 1024 * 1024


class HttpPolicy:
    """Client of a policy in another process; its pictures are those that the process asks for."""

    def __init__(self, address: str, answer_s: float = ANSWER_S) -> None:
        """Ask the process for its pictures.

        Raises:
            ConfigError: if `address` is no `http://HOST:PORT` of this machine.
            InputError: `bad_policy` if nothing answers there, or not as a policy.
        """
        self._host, self._port = _parse_address(address)
        self._answer_s, self._session = answer_s, secrets.token_hex(8)
        self._connection: http.client.HTTPConnection | None = None
        try:
            told = self._ask("/describe", {})
        except PolicyError as error:
            raise InputError(f"policy {address}: {error}", "bad_policy") from None
        pictures, size = told.get("pictures"), told.get("picture_size")
        self.pictures: tuple[str, ...] = tuple(pictures) if isinstance(pictures, list) else pictures  # type: ignore[assignment]
        self.picture_size: tuple[int, int] = tuple(size) if isinstance(size, list) else size  # type: ignore[assignment]
        check_policy(self, address)

    def reset(self, start: EpisodeStart) -> None:
        """Begin an episode; PolicyGoneError if nothing listens any more."""
        self._ask("/reset", {"session": self._session, "start": encode_start(start)})

    def act(self, observation: Mapping[str, np.ndarray]) -> np.ndarray:
        """Ask for the next action."""
        seen = {name: encode_array(array) for name, array in observation.items()}
        action = self._ask("/act", {"session": self._session, "observation": seen}).get("action")
        if not isinstance(action, list) or not all(type(value) in (int, float) for value in action):
            raise PolicyError("bad_action", f"/act answers no list of numbers as `action`: {action!r:.80}")
        return np.array(action, dtype=np.float64)

    def _ask(self, path: str, body: Mapping[str, Any]) -> dict[str, Any]:
        """Post a message and read its answer; once more if the server has closed an idle connection."""
        for fresh in (self._connection is None, True):
            if self._connection is None:
                self._connection = http.client.HTTPConnection(self._host, self._port, timeout=self._answer_s)
            try:
                self._connection.request("POST", path, json.dumps(body), {"Content-Type": "application/json"})
                response = self._connection.getresponse()
                data = response.read(MAX_ANSWER_BYTES + 1)
                return _parse_answer(path, response.status, data)
            except TimeoutError:
                self._close()
                raise PolicyError("policy_timeout", f"{path}: no answer within {self._answer_s:g} s") from None
            except (http.client.RemoteDisconnected, ConnectionResetError, BrokenPipeError) as error:
                self._close()
                if fresh:
                    raise self._explain_loss(path, error) from None
            except ConnectionRefusedError as error:
                self._close()
                raise self._explain_loss(path, error) from None
            except (OSError, http.client.HTTPException) as error:
                self._close()
                raise _connection_error(path, error) from None
            except PolicyError:
                self._close()
                raise
        raise AssertionError("the second try is fresh")

    def _explain_loss(self, path: str, error: OSError) -> Exception:
        """Explain a lost connection: an ending server also resets those that it had not accepted yet."""
        if path == "/reset" and not self._listens():  # no episode has begun that could be lost
            problem = f"nothing answers at http://{self._host}:{self._port} any more: start the policy again"
            return PolicyGoneError(f"{problem}, and the same command goes on", "bad_policy")
        return _connection_error(path, error)

    def _listens(self) -> bool:
        try:
            socket.create_connection((self._host, self._port), self._answer_s).close()
        except OSError:
            return False
        return True

    def _close(self) -> None:
        if self._connection is not None:
            self._connection.close()
            self._connection = None


def _parse_address(address: str) -> tuple[str, int]:
    shown = sanitize_line(address, 100)
    try:
        parts = urlsplit(address)
        port = parts.port
    except ValueError as error:
        raise ConfigError(f"policy {shown}: is no address: {error}") from None
    plain = parts.scheme == "http" and parts.path in ("", "/") and not (parts.query or parts.fragment or parts.username)
    if not plain or parts.hostname is None or port is None or not is_loopback(address):
        raise ConfigError(f"policy {shown}: give http://127.0.0.1:PORT, an address of this machine with its port")
    return parts.hostname, port


def _parse_answer(path: str, status: int, data: bytes) -> dict[str, Any]:
    if len(data) > MAX_ANSWER_BYTES:
        raise PolicyError("policy_error", f"{path}: the answer is longer than {MAX_ANSWER_BYTES} bytes")
    try:
        value = json.loads(data)
    except (ValueError, RecursionError) as error:
        raise PolicyError("policy_error", f"{path}: the answer is no JSON: {describe_error(error)}"[:300]) from None
    if not isinstance(value, dict):
        raise PolicyError("policy_error", f"{path}: the answer is no object of JSON")
    if status != 200:
        told = sanitize_line(str(value.get("error", "")), 200)
        raise PolicyError("policy_error", f"{path}: status {status}{': ' + told if told else ''}")
    return value


def _connection_error(path: str, error: Exception) -> PolicyError:
    return PolicyError("policy_error", sanitize_line(f"{path}: {type(error).__name__}: {describe_error(error)}", 300))
