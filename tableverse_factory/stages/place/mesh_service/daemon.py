"""Daemon that owns one mesh process for all workers: `python -m tableverse_factory.stages.place.mesh_service.daemon`.

Each request is for the objects of a scene. Waiting requests go to the process together, and meshes are cached on disk
at once, from where the workers read them: a killed worker loses no mesh, neither its own nor those of others.
"""

import atexit
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from schemas.identity import content_hash
from tableverse_factory.models.local.batch_server import Arrays, BatchModel, Heartbeat
from tableverse_factory.models.local.model_daemon import Spec, ask_daemon, run_daemon
from tableverse_factory.stages.place.mesh_service.process import MeshProcess, ProcessFaultError, select_environment
from tableverse_factory.stages.place.mesh_service.requests import MeshRequest, SceneRequest, build_question

SCENES = 8  # maximum number of scenes in a batch
_CLOSE_S = 2.0  # time for the process to end by itself [s]


def build_spec(command: tuple[str, ...]) -> Spec:
    """Build the identity of a process: its command, working directory and environment."""
    passed = json.dumps(select_environment(), sort_keys=True).encode()
    return {"command": json.dumps(command), "folder": str(Path.cwd()), "environment": content_hash(passed)}


def request_meshes(command: tuple[str, ...], request: Mapping[str, Any]) -> Any:
    """Send a request of `client.MeshClient` to the daemon of a command.

    Raises:
        ModelAccessError: if the process cannot be started.
        ModelError: if the daemon dies at every attempt.
    """
    return decode_json(ask_daemon(__name__, build_spec(command), encode_json(request)))


def encode_json(message: Any) -> Arrays:
    """Encode a message of a worker or the daemon for the connection between them."""
    return [np.frombuffer(json.dumps(message).encode(), dtype=np.uint8)]


def decode_json(arrays: Arrays) -> Any:
    """Decode a message of a worker or the daemon."""
    return json.loads(arrays[0].tobytes())


class MeshDaemon:
    """Owner of a mesh process, which it replaces after a fault; `heartbeat` is called every second of any wait."""

    def __init__(self, command: tuple[str, ...], heartbeat: Callable[[], None] = lambda: None) -> None:
        self._command, self._heartbeat = command, heartbeat
        self._process: MeshProcess | None = None
        self._model: dict[str, Any] = {}
        self.ensure_process()

    def answer_scenes(self, questions: Sequence[Arrays]) -> Iterator[Arrays]:
        """Yield the answer to each scene, in order, as soon as its last object is settled."""
        scenes = [SceneRequest(decode_json(question)) for question in questions]
        self.ensure_process()
        for scene in scenes:
            scene.check_model(self._model)
        for scene in scenes:
            while scene.open_meshes():
                self._settle_next([mesh for scene in scenes for mesh in scene.open_meshes()])
            yield encode_json(scene.build_answer(self._model))

    def close(self) -> None:
        """End the process."""
        if self._process is not None:
            self._process.close(_CLOSE_S)
            self._process = None

    def _settle_next(self, meshes: Sequence[MeshRequest]) -> None:
        """Settle the next objects, each content once, as many as the process makes at a time.

        A process that dies, falls silent or sends an invalid answer is replaced, and the open objects are requested
        again one at a time; an object at which it fails again has no mesh.
        """
        by_key: dict[str, MeshRequest] = {}
        for mesh in meshes:
            by_key.setdefault(mesh.key, mesh)
        missing = (mesh for mesh in by_key.values() if not mesh.find_cached())
        requested = list(islice(missing, self.ensure_process().hello.batch))
        try:
            self._ask(requested)
        except ProcessFaultError:
            for mesh in requested:
                if mesh.is_open:
                    try:
                        self._ask([mesh])
                    except ProcessFaultError as fault:
                        mesh.fail(fault)

    def _ask(self, meshes: Sequence[MeshRequest]) -> None:
        """Request the objects whose scenes expect this process, and cache their meshes.

        Raises:
            ProcessFaultError: if the process failed; it has been ended then.
        """
        process = self.ensure_process()
        for mesh in meshes:
            mesh.scene.check_model(self._model)
        meshes = [mesh for mesh in meshes if mesh.is_open]
        if not meshes:
            return
        try:
            process.load()
            silence_s = max(mesh.scene.silence_s for mesh in meshes)
            answers = process.post_question(build_question(meshes), silence_s).get("meshes")
            if not isinstance(answers, list) or len(answers) != len(meshes):
                raise ProcessFaultError("it sent not as many 'meshes' as objects")
            for mesh, answer in zip(meshes, answers, strict=True):
                mesh.store_answer(answer, self._model)
        except BaseException as error:  # the process may still work on this request
            self._process = None
            process.close()
            if not isinstance(error, ProcessFaultError):
                raise
            line = process.output.read_last_line()
            raise ProcessFaultError(f"{error}; it says: {line}" if line else str(error)) from error

    def ensure_process(self) -> MeshProcess:
        """Return the process, started anew if it has died."""
        if self._process is None or not self._process.is_alive:
            self.close()
            self._process = MeshProcess(self._command, self._heartbeat)
            self._model = self._process.hello.describe_model()
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
