"""Daemon that owns one mesh process for all workers: `python -m tableverse_factory.stages.place.mesh_service.daemon`.

Each request is for the objects of a scene. Waiting requests go to the process together, and meshes are cached on disk
at once, from where the workers read them: a killed worker loses no mesh, neither its own nor those of others.
"""

import atexit
import json
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from schemas.identity import content_hash
from tableverse_factory.models.local.batch_server import Arrays, BatchModel, Heartbeat
from tableverse_factory.models.local.model_daemon import Spec, ask_daemon, run_daemon
from tableverse_factory.stages.place.mesh_service.process import (
    MeshFrame,
    MeshProcess,
    ProcessFaultError,
    select_environment,
)
from tableverse_factory.stages.place.mesh_service.requests import (
    MeshRequest,
    SceneRequest,
    build_message,
    describe_process,
)

SCENES, OBJECTS = 8, 32
"""Maximum number of scenes in a batch, and of objects in one request to the process."""
_CLOSE_S = 2.0
"""Time for the process to end by itself [s]."""


def build_spec(command: tuple[str, ...]) -> Spec:
    """Build the identity of a process: its command, working directory and environment."""
    passed = json.dumps(select_environment(), sort_keys=True).encode()
    return {"command": json.dumps(command), "folder": str(Path.cwd()), "environment": content_hash(passed)}


def request_meshes(command: tuple[str, ...], request: MeshFrame) -> MeshFrame:
    """Send a request of `client.MeshClient` to the daemon of a command.

    Raises:
        ModelAccessError: if the process cannot be started.
        ModelError: if the daemon dies at every attempt.
    """
    (answer,) = ask_daemon(
        __name__, build_spec(command), [np.frombuffer(b"".join(request.encode_parts()), dtype=np.uint8)]
    )
    return MeshFrame.decode(answer.tobytes())


class MeshDaemon:
    """Owner of a mesh process, which it replaces after a fault."""

    def __init__(self, command: tuple[str, ...], heartbeat: Callable[[], None] = lambda: None) -> None:
        """Start the process.

        Args:
            command: Program and arguments.
            heartbeat: Called every second of any wait.

        Raises:
            ModelAccessError: if the process cannot be started.
        """
        self._command, self._heartbeat = command, heartbeat
        self._process: MeshProcess | None = None
        self._hello: dict[str, Any] = {}
        self._numbers = count()
        self.ensure_process()

    def answer_scenes(self, questions: Sequence[Arrays]) -> Iterator[Arrays]:
        """Yield the answer to each scene, in order, as soon as its last object is settled."""
        scenes = [SceneRequest(MeshFrame.decode(question.tobytes())) for (question,) in questions]
        self.ensure_process()
        for scene in scenes:
            scene.check_process(self._hello)
        work = self._settle_open(scenes)
        for scene in scenes:
            while scene.open_meshes():
                next(work)
            yield [np.frombuffer(b"".join(scene.build_answer(self._hello).encode_parts()), dtype=np.uint8)]
        for _ in work:  # objects of a request whose scene was given up meanwhile
            pass

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.close(_CLOSE_S)
            self._process = None

    def _settle_open(self, scenes: Sequence[SceneRequest]) -> Iterator[None]:
        """Settle all open objects; yields whenever an object may have been settled."""
        while meshes := [mesh for scene in scenes for mesh in scene.open_meshes()]:
            yield from self._settle_request(meshes)
            yield

    def _settle_request(self, meshes: Sequence[MeshRequest]) -> Iterator[None]:
        """Settle the objects of one request, each content once.

        A process that dies, falls silent or sends an invalid message is replaced, and the open objects are requested
        again one at a time; an object at which it fails again has no mesh.
        """
        by_key: dict[str, MeshRequest] = {}
        for mesh in meshes:
            by_key.setdefault(mesh.key, mesh)
        requested = [mesh for mesh in list(by_key.values())[:OBJECTS] if not mesh.find_cached()]
        try:
            yield from self._ask(requested)
        except ProcessFaultError:
            for mesh in requested:
                if mesh.is_open:
                    try:
                        yield from self._ask([mesh])
                    except ProcessFaultError as fault:
                        mesh.fail(fault)

    def _ask(self, meshes: Sequence[MeshRequest]) -> Iterator[None]:
        """Request the objects whose scenes expect this process; caches meshes as they come, and yields after each.

        Raises:
            ModelAccessError: if the process cannot be started, or cannot load its weights.
            ProcessFaultError: if the process failed; it has been ended then.
        """
        process = self.ensure_process()
        for mesh in meshes:
            mesh.scene.check_process(self._hello)
        meshes = [mesh for mesh in meshes if mesh.is_open]
        if not meshes:
            return
        silence_s = max(mesh.scene.silence_s for mesh in meshes)
        open_meshes = {str(next(self._numbers)): mesh for mesh in meshes}
        try:
            process.load()
            process.send(build_message(open_meshes), silence_s)
            while open_meshes:
                frame = process.receive(silence_s)
                name = frame.head.get("id")
                if not isinstance(name, str) or name not in open_meshes:
                    raise ProcessFaultError("it answered for an object that was not asked for")
                open_meshes[name].store_answer(frame, self._hello)
                del open_meshes[name]
                yield
        except BaseException as error:  # the process may still send answers to this request
            self._process = None
            process.close()
            if not isinstance(error, ProcessFaultError):
                raise
            line = process.read_last_line()
            raise ProcessFaultError(f"{error}; it says: {line}" if line else str(error)) from error

    def ensure_process(self) -> MeshProcess:
        """Return the process, started anew if it has died."""
        if self._process is None or not self._process.is_alive:
            self.close()
            self._process = MeshProcess(self._command, self._heartbeat)
            self._hello = describe_process(self._process.hello)
        return self._process


def configure_mesh_daemon(spec: Spec) -> tuple[int, Callable[[Heartbeat], BatchModel]]:
    """Return the batch size, and a function that starts the daemon of a description."""

    def make(heartbeat: Heartbeat) -> BatchModel:
        daemon = MeshDaemon(tuple(json.loads(str(spec["command"]))), heartbeat)
        atexit.register(daemon.close)
        return daemon.answer_scenes

    return SCENES, make


if __name__ == "__main__":
    run_daemon(configure_mesh_daemon)
