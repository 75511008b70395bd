"""Answers that were paid for, on disk by the hash of what was asked: a killed build asks nothing twice."""

import json
import tempfile
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

from schemas.identity import content_hash
from tableverse_factory.core.disk_cache import DiskCache
from tableverse_factory.core.errors import ModelAccessError
from tableverse_factory.models.remote.endpoint import Endpoint
from tableverse_factory.models.remote.exchange import ChatCompletion, Message, Usage

_VERSION = b"answers 1"


class AnswerCache:
    """A JSON file per answer. Safe to share between processes and to delete."""

    def __init__(self, cache_dir: Path) -> None:
        self._files = DiskCache(cache_dir / "answers", ".json", durable=True)

    def get(self, key: str) -> ChatCompletion | None:
        """The answer kept under a key; None where there is none, or the file is damaged."""
        payload = self._files.get(key)
        if payload is None:
            return None
        record = json.loads(payload)
        return ChatCompletion(**{**record, "usage": Usage(**record["usage"])})

    def put(self, key: str, completion: ChatCompletion) -> None:
        """Keeps an answer.

        Raises:
            ModelAccessError: if the disk refuses: going on would pay for answers that are lost.
        """
        try:
            self._files.put(key, json.dumps(asdict(completion), sort_keys=True).encode())
        except OSError as error:
            raise _cannot_keep(self._files.folder, error) from error

    def check(self) -> None:
        """Makes sure before anything is paid that answers can be kept.

        Raises:
            ModelAccessError: if the folder cannot be written.
        """
        try:
            self._files.folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self._files.folder):
                pass
        except OSError as error:
            raise _cannot_keep(self._files.folder, error) from error


def answer_key(endpoint: Endpoint, turns: tuple[Message, ...], schema: Mapping[str, Any]) -> str:
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
