"""Keeps one mesh process for all workers of a machine: `python -m tableverse_factory.place.mesh_keeper`.

Workers ask for the objects of a scene each. What waits goes to the process together, and what comes back is put on the
disk at once, from where whoever asked reads it: a worker that is killed loses nobody anything, itself included.
"""

import atexit
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tableverse_factory.checked_files import CheckedFiles
from tableverse_factory.errors import ModelAccessError, ModelError
from tableverse_factory.neural.serving import Answer, Arrays, Stay
from tableverse_factory.neural.shared import Spec, ask, main
from tableverse_factory.place.mesh_process import Frame, Hello, MeshProcess, ProcessFaultError
from tableverse_factory.text import printable

FORMATS = ("glb", "obj", "ply", "stl")
UPS = ("y", "z")
FAULTS_IN_A_ROW = 3
"""Objects of a scene, one after the other, at which the process fails twice: so many are not the objects' fault."""
SCENES, OBJECTS = 8, 32
"""Asked for together; in one request: when the process dies, so many are asked for again, one at a time."""
_MAX_REASON = 300
_CLOSE_S = 2.0
"""In which the process may end by itself [s]."""


def ask_keeper(command: tuple[str, ...], question: Frame) -> Frame:
    """What the keeper of this command's process says to one scene's objects (see `mesh_orders`).

    Raises:
        ModelAccessError: if no process can be started, or the disk refuses to keep answers.
        ModelError: if the keeper dies again and again.
    """
    has_relative = any(Path(word).exists() and not Path(word).is_absolute() for word in command)
    spec: Spec = {"command": json.dumps(command), "folder": str(Path.cwd()) if has_relative else ""}
    (answer,) = ask(__name__, spec, [np.frombuffer(b"".join(question.packed()), dtype=np.uint8)])
    return Frame.read(answer.tobytes())


class Keeper:
    """One process, and its replacements."""

    def __init__(self, command: tuple[str, ...], stay: Callable[[], None] = lambda: None) -> None:
        """Starts it; `stay` is called every second of any wait.

        Raises:
            ModelAccessError: if it cannot be started.
        """
        self._command, self._stay = command, stay
        self._process: MeshProcess | None = None
        self._started()

    def answers(self, questions: Sequence[Arrays]) -> Iterator[Arrays]:
        """The answer to each scene, as soon as its last object has one."""
        scenes = [_Scene(Frame.read(question.tobytes())) for (question,) in questions]
        who = described(self._started().hello)
        for scene in scenes:
            scene.meant(who)
        for scene in scenes:
            while scene.open_things():
                self._make([thing for other in scenes for thing in other.open_things()])
            yield [np.frombuffer(b"".join(scene.told(who).packed()), dtype=np.uint8)]

    def close(self) -> None:
        """Ends the process."""
        if self._process is not None:
            self._process.close(_CLOSE_S)
            self._process = None

    def _make(self, things: Sequence["_Thing"]) -> None:
        """Settles as many as one request takes, each content once.

        A process that dies, falls silent or sends nonsense is replaced, and what it owed is asked for once more, an
        object at a time; an object that does it again has no mesh.
        """
        by_key: dict[str, _Thing] = {}
        for thing in things:
            by_key.setdefault(thing.key, thing)
        wanted = [thing for thing in list(by_key.values())[:OBJECTS] if not thing.is_kept()]
        try:
            self._ask(wanted)
        except ProcessFaultError:
            for thing in wanted:
                if thing.is_open:
                    try:
                        self._ask([thing])
                    except ProcessFaultError as fault:
                        thing.fail(fault)

    def _ask(self, things: Sequence["_Thing"]) -> None:
        """One request for all of these; answers are kept as they come.

        Raises:
            ProcessFaultError: if the process is of no use any more; it is ended then.
            ModelError: if it is another one than before.
        """
        if not things:
            return
        process = self._started()
        who = described(process.hello)
        if any(thing.scene.to != who for thing in things):
            raise ModelError("the mesh process says that it is another one since it was started again")
        process.load()
        silence_s = max(thing.scene.silence_s for thing in things)
        owed = {str(number): thing for number, thing in enumerate(things)}
        try:
            process.send(_request(things), silence_s)
            while owed:
                frame = process.receive(silence_s)
                name = frame.head.get("id")
                if not isinstance(name, str) or name not in owed:
                    raise ProcessFaultError("it answered for an object that was not asked for")
                owed[name].settle(frame, who)
                del owed[name]
        except ProcessFaultError as fault:
            self._process = None
            process.close()
            said = process.last_words()
            raise ProcessFaultError(f"{fault}; it says: {said}" if said else str(fault)) from fault

    def _started(self) -> MeshProcess:
        """The process, a fresh one where it has died."""
        if self._process is None or not self._process.is_alive:
            self.close()
            self._process = MeshProcess(self._command, self._stay)
        return self._process


class _Scene:
    """What a worker asks, and what has come of it.

    Attributes:
        to: Whom it means, as `described`; None where it does not know yet.
        silence_s: Longest wait between two answers [s].
        kept: Where answers are put.
    """

    def __init__(self, question: Frame) -> None:
        head, (self.picture, self.depth, *masks) = question.head, question.parts
        self.to: dict[str, Any] | None = head["to"]
        self.silence_s, self.camera, self._count = float(head["silence_s"]), head["camera"], head["of"]
        self.kept = CheckedFiles(Path(head["kept_in"]), ".frame", durable=True)
        self._things = [_Thing(self, mask, **entry) for mask, entry in zip(masks, head["objects"], strict=True)]
        self._faults: dict[int, str] = {}
        self._given_up = ""

    def meant(self, who: dict[str, Any]) -> None:
        """Nothing is made where another process was meant: who asked is told which this one is."""
        if self.to != who:
            self._things = []

    def open_things(self) -> list["_Thing"]:
        """What is still to be made."""
        return [] if self._given_up else [thing for thing in self._things if thing.reason is None]

    def fail(self, number: int, reason: str, fault: ProcessFaultError) -> None:
        """An object has none; a scene of such is given up."""
        self._faults[number] = reason
        # In a row in the scene: what was kept of it counts as what is made now does.
        if all(number - before in self._faults for before in range(FAULTS_IN_A_ROW)):
            self._given_up = f"at {FAULTS_IN_A_ROW} objects in a row the mesh process failed twice: {fault}"
        elif len(self._faults) == self._count:
            self._given_up = f"the mesh process made none of {self._count} meshes: {self._faults[0]}"

    def told(self, who: dict[str, Any]) -> Frame:
        """The answer."""
        reasons = {str(thing.number): thing.reason for thing in self._things if thing.reason}
        return Frame({"who": who, "reasons": reasons, "given_up": self._given_up})


@dataclass(slots=True, eq=False)
class _Thing:
    """An object of a scene.

    Attributes:
        scene: Whose picture it is in.
        mask: A PNG file.
        number: In its scene.
        key: Under which its mesh is kept.
        seed: For what the model draws at random.
        reason: Why it has no mesh; empty where one is kept, None until that is known.
    """

    scene: _Scene
    mask: bytes
    number: int
    key: str
    seed: int
    reason: str | None = None

    @property
    def is_open(self) -> bool:
        """Whether it is still to be made."""
        return self in self.scene.open_things()

    def is_kept(self) -> bool:
        """Whether somebody has asked for the same meanwhile."""
        if self.scene.kept.get(self.key) is not None:
            self.reason = ""
        return self.reason is not None

    def settle(self, frame: Frame, who: dict[str, Any]) -> None:
        """Takes what the process says of it; a mesh is put on the disk, with who gave it and under which licence.

        Raises:
            ProcessFaultError: if that is no answer.
            ModelAccessError: if the disk refuses.
        """
        head = frame.head
        if head.get("type") == "failed":
            self.reason = f"the model has no mesh: {printable(str(head.get('reason')), _MAX_REASON)}"
            return
        if head.get("type") != "mesh" or len(frame.parts) != 1:
            raise ProcessFaultError("it sent a message that is no answer")
        if head.get("format") not in FORMATS or head.get("up") not in UPS:
            self.reason = f"its mesh names no format of {', '.join(FORMATS)} with an up axis of {' or '.join(UPS)}"
            return
        kept = Frame({**who, "format": head["format"], "up": head["up"]}, frame.parts)
        try:
            self.scene.kept.put(self.key, b"".join(kept.packed()))
        except OSError as error:
            raise ModelAccessError(
                f"meshes cannot be kept in {self.scene.kept.folder}: {error.strerror or error}. Make room, or name "
                "another folder in TABLEVERSE_CACHE"
            ) from error
        self.reason = ""

    def fail(self, fault: ProcessFaultError) -> None:
        """The process has failed at it twice."""
        self.reason = f"the mesh process failed twice: {fault}"
        self.scene.fail(self.number, self.reason, fault)


def described(hello: Hello) -> dict[str, Any]:
    """Who answers, as it is told and kept."""
    return {**asdict(hello), "wants": sorted(hello.wants)}


def make(spec: Spec) -> tuple[int, Callable[[Stay], Answer]]:
    """The most scenes at a time, and what starts the keeper of the command that a spec names."""

    def made(stay: Stay) -> Answer:
        keeper = Keeper(tuple(json.loads(str(spec["command"]))), stay)
        atexit.register(keeper.close)
        return keeper.answers

    return SCENES, made


def _request(things: Sequence[_Thing]) -> Frame:
    """The message that asks for these, each picture in it once."""
    parts: list[bytes] = []
    pictures: list[dict[str, Any]] = []
    places: dict[_Scene, int] = {}
    objects = []

    def put(part: bytes) -> int:
        parts.append(part)
        return len(parts) - 1

    for number, thing in enumerate(things):
        scene = thing.scene
        if scene not in places:
            places[scene] = len(pictures)
            depth = put(scene.depth) if scene.depth else None
            pictures.append({"picture": put(scene.picture), "depth": depth, "camera": scene.camera})
        objects.append({"id": str(number), "picture": places[scene], "mask": put(thing.mask), "seed": thing.seed})
    return Frame({"type": "make", "pictures": pictures, "objects": objects}, tuple(parts))


if __name__ == "__main__":
    main(make)
