"""Keeps one mesh process for all workers of a machine: `python -m tableverse_factory.stages.place.mesh_service.daemon`.

Workers ask for the objects of a scene each. What waits goes to the process together, and what comes back is put on the
disk at once, from where whoever asked reads it: a worker that is killed loses nobody anything, itself included.
"""

import atexit
import json
from collections.abc import Callable, Iterator, Sequence
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

from schemas.identity import content_hash
from tableverse_factory.models.local.batch_server import Answer, Arrays, Heartbeat
from tableverse_factory.models.local.model_daemon import Spec, ask, main
from tableverse_factory.stages.place.mesh_service.process import MeshFrame, MeshProcess, ProcessFaultError, environment
from tableverse_factory.stages.place.mesh_service.requests import MeshRequest, SceneRequest, described, request_for

SCENES, OBJECTS = 8, 32
"""Asked for together; in one request: when the process dies, so many are asked for again, one at a time."""
_CLOSE_S = 2.0
"""In which the process may end by itself [s]."""


def spec_of(command: tuple[str, ...]) -> Spec:
    """What tells one process from another: the same words name others elsewhere, or with other variables."""
    passed = json.dumps(environment(), sort_keys=True).encode()
    return {"command": json.dumps(command), "folder": str(Path.cwd()), "environment": content_hash(passed)}


def ask_keeper(command: tuple[str, ...], question: MeshFrame) -> MeshFrame:
    """What the keeper of this command's process says to one scene's objects (see `mesh_orders`).

    Raises:
        ModelAccessError: if no process can be started.
        ModelError: if the keeper dies again and again.
    """
    (answer,) = ask(__name__, spec_of(command), [np.frombuffer(b"".join(question.packed()), dtype=np.uint8)])
    return MeshFrame.read(answer.tobytes())


class MeshDaemon:
    """One process, and its replacements."""

    def __init__(self, command: tuple[str, ...], stay: Callable[[], None] = lambda: None) -> None:
        """Starts it; `stay` is called every second of any wait.

        Raises:
            ModelAccessError: if it cannot be started.
        """
        self._command, self._stay = command, stay
        self._process: MeshProcess | None = None
        self._who: dict[str, Any] = {}
        self._numbers = count()
        self._started()

    def answers(self, questions: Sequence[Arrays]) -> Iterator[Arrays]:
        """The answer to each scene, as soon as its last object has one and those before it are told."""
        scenes = [SceneRequest(MeshFrame.read(question.tobytes())) for (question,) in questions]
        self._started()
        for scene in scenes:
            scene.meant(self._who)
        work = self._worked(scenes)
        for scene in scenes:
            while scene.open_meshes():
                next(work)
            yield [np.frombuffer(b"".join(scene.told(self._who).packed()), dtype=np.uint8)]
        for _ in work:  # what a scene is still owed that has been given up meanwhile
            pass

    def close(self) -> None:
        """Ends the process."""
        if self._process is not None:
            self._process.close(_CLOSE_S)
            self._process = None

    def _worked(self, scenes: Sequence[SceneRequest]) -> Iterator[None]:
        """Settles all that is open, with a stop wherever something may have been."""
        while meshes := [mesh for scene in scenes for mesh in scene.open_meshes()]:
            yield from self._make(meshes)
            yield

    def _make(self, meshes: Sequence[MeshRequest]) -> Iterator[None]:
        """Settles as many as one request takes, each content once.

        A process that dies, falls silent or sends nonsense is replaced, and what it owed is asked for once more, an
        object at a time; an object that does it again has no mesh.
        """
        by_key: dict[str, MeshRequest] = {}
        for mesh in meshes:
            by_key.setdefault(mesh.key, mesh)
        wanted = [mesh for mesh in list(by_key.values())[:OBJECTS] if not mesh.is_kept()]
        try:
            yield from self._ask(wanted)
        except ProcessFaultError:
            for mesh in wanted:
                if mesh.is_open:
                    try:
                        yield from self._ask([mesh])
                    except ProcessFaultError as fault:
                        mesh.fail(fault)

    def _ask(self, meshes: Sequence[MeshRequest]) -> Iterator[None]:
        """One request for all of these that mean this very process; answers are kept as they come, with a stop at each.

        Raises:
            ModelAccessError: if it cannot be started, or cannot load its weights.
            ProcessFaultError: if the process is of no use any more; it is ended then.
        """
        process = self._started()
        for mesh in meshes:
            mesh.scene.meant(self._who)
        meshes = [mesh for mesh in meshes if mesh.is_open]
        if not meshes:
            return
        silence_s = max(mesh.scene.silence_s for mesh in meshes)
        owed = {str(next(self._numbers)): mesh for mesh in meshes}
        try:
            process.load()
            process.send(request_for(owed), silence_s)
            while owed:
                frame = process.receive(silence_s)
                name = frame.head.get("id")
                if not isinstance(name, str) or name not in owed:
                    raise ProcessFaultError("it answered for an object that was not asked for")
                owed[name].settle(frame, self._who)
                del owed[name]
                yield
        except BaseException as error:  # whatever it is: answers may be on their way that nobody asks for any more
            self._process = None
            process.close()
            if not isinstance(error, ProcessFaultError):
                raise
            said = process.last_words()
            raise ProcessFaultError(f"{error}; it says: {said}" if said else str(error)) from error

    def _started(self) -> MeshProcess:
        """The process, a fresh one where it has died."""
        if self._process is None or not self._process.is_alive:
            self.close()
            self._process = MeshProcess(self._command, self._stay)
            self._who = described(self._process.hello)
        return self._process


def make(spec: Spec) -> tuple[int, Callable[[Heartbeat], Answer]]:
    """The most scenes at a time, and what starts the keeper of the command that a spec names."""

    def made(stay: Heartbeat) -> Answer:
        keeper = MeshDaemon(tuple(json.loads(str(spec["command"]))), stay)
        atexit.register(keeper.close)
        return keeper.answers

    return SCENES, made


if __name__ == "__main__":
    main(make)
