"""Answers that were paid for, on disk by the hash of what was asked: a killed build asks nothing twice."""

import json
import os
import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from schemas.identity import content_hash
from tableverse_factory.errors import ModelAccessError
from tableverse_factory.models.endpoint import Endpoint
from tableverse_factory.models.exchange import Completion, Turn, Usage

_VERSION = b"answers 1"
_DIGEST_CHARS = 64


class AnswerCache:
    """A file per answer: the hash of its bytes, then JSON. Safe to share between processes and to delete."""

    def __init__(self, cache_dir: Path) -> None:
        self._folder = cache_dir / "answers"

    def get(self, key: str) -> Completion | None:
        """The answer kept under a key; None where there is none, or the file is damaged."""
        try:
            data = self._path(key).read_bytes()
        except OSError:
            return None
        digest, payload = data[:_DIGEST_CHARS], data[_DIGEST_CHARS:]
        if digest != content_hash(payload).encode():
            return None
        record = json.loads(payload)
        return Completion(**{**record, "usage": Usage(**record["usage"])})

    def put(self, key: str, completion: Completion) -> None:
        """Keeps an answer: whole or not at all, whoever else writes the same.

        Raises:
            ModelAccessError: if the disk refuses: going on would pay for answers that are lost.
        """
        path = self._path(key)
        payload = json.dumps(asdict(completion), sort_keys=True).encode()
        temporary = None
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".part")
            with os.fdopen(handle, "wb") as file:
                file.write(content_hash(payload).encode() + payload)
                file.flush()
                os.fsync(file.fileno())
            Path(temporary).replace(path)
        except OSError as error:
            if temporary is not None:
                Path(temporary).unlink(missing_ok=True)
            raise _cannot_keep(path.parent, error) from error

    def check(self) -> None:
        """Makes sure before anything is paid that answers can be kept.

        Raises:
            ModelAccessError: if the folder cannot be written.
        """
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self._folder):
                pass
        except OSError as error:
            raise _cannot_keep(self._folder, error) from error

    def _path(self, key: str) -> Path:
        return self._folder / key[:2] / f"{key}.json"


def answer_key(endpoint: Endpoint, turns: tuple[Turn, ...], schema: Mapping[str, Any]) -> str:
    """Hash of what decides an answer: the model and where it runs, the prompt, the schema, the pictures."""
    parts = [_VERSION, endpoint.dialect.encode(), endpoint.base_url.encode(), endpoint.model.encode()]
    parts += [json.dumps(schema, sort_keys=True).encode(), b"enforced" if endpoint.enforce_schema else b"asked"]
    for turn in turns:
        parts += [turn.role.encode(), turn.text.encode(), str(len(turn.images)).encode(), *turn.images]
    return content_hash(*parts)


def _cannot_keep(folder: Path, error: OSError) -> ModelAccessError:
    return ModelAccessError(
        f"answers cannot be kept in {folder}: {error.strerror or error}. Make room, or name another folder "
        "in TABLEVERSE_CACHE"
    )
