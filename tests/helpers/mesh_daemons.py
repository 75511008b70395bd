"""Mesh daemons inside of a test's own process."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from tableverse_factory.stages.place.mesh_service import client
from tableverse_factory.stages.place.mesh_service.daemon import MeshDaemon
from tableverse_factory.stages.place.mesh_service.process import MeshFrame


@contextmanager
def daemons_inside(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[tuple[str, ...], MeshDaemon]]:
    """Route requests to daemons in this process, by command; a test that removes one must close it."""
    daemons: dict[tuple[str, ...], MeshDaemon] = {}

    def ask(command: tuple[str, ...], question: MeshFrame) -> MeshFrame:
        if command not in daemons:
            daemons[command] = MeshDaemon(command)
        data = np.frombuffer(b"".join(question.encode_parts()), dtype=np.uint8)
        ((answer,),) = daemons[command].answer_scenes([[data]])
        return MeshFrame.decode(answer.tobytes())

    monkeypatch.setattr(client, "request_meshes", ask)
    monkeypatch.setattr(client, "_HELLO_CACHE", {})
    yield daemons
    for daemon in daemons.values():
        daemon.close()
