"""Cache of paid answers on disk, keyed by a hash of the question, so that a killed build pays nothing twice."""

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
    """Folder with a JSON file per answer; safe to share between processes and to delete."""

    def __init__(self, cache_dir: Path) -> None:
        self._files = DiskCache(cache_dir / "answers", ".json", durable=True)

    def get(self, key: str) -> ChatCompletion | None:
        """Return the answer of a key, or None if there is none or its file is damaged."""
        payload = self._files.get(key)
        if payload is None:
            return None
        record = json.loads(payload)
        return ChatCompletion(**{**record, "usage": Usage(**record["usage"])})

    def put(self, key: str, completion: ChatCompletion) -> None:
        """Store an answer; ModelAccessError if the disk refuses: further answers would be paid for and lost."""
        try:
            self._files.put(key, json.dumps(asdict(completion), sort_keys=True).encode())
        except OSError as error:
            raise _describe_disk_error(self._files.folder, error) from error

    def check(self) -> None:
        """Check that answers can be stored, before one is paid for."""
        try:
            self._files.folder.mkdir(parents=True, exist_ok=True)
            with tempfile.TemporaryFile(dir=self._files.folder):
                pass
        except OSError as error:
            raise _describe_disk_error(self._files.folder, error) from error


def compute_answer_key(endpoint: Endpoint, messages: tuple[Message, ...], schema: Mapping[str, Any]) -> str:
    """Hash all that determines an answer: address and model, prompt, schema and images."""
    parts = [_VERSION, endpoint.dialect.encode(), endpoint.base_url.encode(), endpoint.model.encode()]
    parts += [json.dumps(schema, sort_keys=True).encode(), b"enforced" if endpoint.enforce_schema else b"asked"]
    for message in messages:
        parts += [message.role.encode(), message.text.encode(), str(len(message.images)).encode(), *message.images]
    return content_hash(*parts)


def _describe_disk_error(folder: Path, error: OSError) -> ModelAccessError:
    return ModelAccessError(
        f"answers cannot be kept in {folder}: {error.strerror or error}. Free space, or set TABLEVERSE_CACHE "
        "to another folder"
    )
