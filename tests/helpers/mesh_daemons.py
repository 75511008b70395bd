"""Mesh daemons inside of a test's own process."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import pytest

from tableverse_factory.stages.place.mesh_service import client
from tableverse_factory.stages.place.mesh_service.daemon import MeshDaemon, decode_json, encode_json


@contextmanager
def daemons_inside(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[tuple[str, ...], MeshDaemon]]:
    """Route requests to daemons in this process, by command; a test that removes one must close it."""
    daemons: dict[tuple[str, ...], MeshDaemon] = {}

    def ask(command: tuple[str, ...], request: Mapping[str, Any]) -> Any:
        if command not in daemons:
            daemons[command] = MeshDaemon(command)
        (answer,) = daemons[command].answer_scenes([encode_json(request)])
        return decode_json(answer)

    monkeypatch.setattr(client, "request_meshes", ask)
    monkeypatch.setattr(client, "_MODEL_CACHE", {})
    yield daemons
    for daemon in daemons.values():
        daemon.close()
