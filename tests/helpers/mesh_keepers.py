"""The keepers of mesh processes inside of a test's own process: what they do needs none of their own to be seen."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from tableverse_factory.stages.place.mesh_service import client
from tableverse_factory.stages.place.mesh_service.daemon import MeshDaemon
from tableverse_factory.stages.place.mesh_service.process import MeshFrame


@contextmanager
def keepers_inside(monkeypatch: pytest.MonkeyPatch) -> Iterator[dict[tuple[str, ...], MeshDaemon]]:
    """What is asked meanwhile goes to keepers here, by command; whoever takes one out must close it."""
    keepers: dict[tuple[str, ...], MeshDaemon] = {}

    def ask(command: tuple[str, ...], question: MeshFrame) -> MeshFrame:
        if command not in keepers:
            keepers[command] = MeshDaemon(command)
        data = np.frombuffer(b"".join(question.packed()), dtype=np.uint8)
        ((answer,),) = keepers[command].answers([[data]])
        return MeshFrame.read(answer.tobytes())

    monkeypatch.setattr(client, "ask_keeper", ask)
    monkeypatch.setattr(client, "_HELLO_CACHE", {})
    yield keepers
    for keeper in keepers.values():
        keeper.close()
