"""A browser as the viewer knows it, without pictures: a real socket, the controls that came through it, and a hand."""

import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgspec.msgpack
import viser
import zstandard
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

_CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, -1.0, 1.0),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 300,
    "image_width": 400,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}


def until(holds: Callable[[], object], seconds: float = 20.0) -> bool:
    end = time.monotonic() + seconds
    while not (held := bool(holds())) and time.monotonic() < end:
        time.sleep(0.02)
    return held


class Looker:
    """Close it, or use it in `with`."""

    def __init__(self, url: str, origin: str | None = None) -> None:
        address = url.replace("http://", "ws://")
        protocol = f"viser-v{viser.__version__}"
        self._socket = connect(address, subprotocols=[protocol], max_size=None, origin=origin)
        self.controls: dict[str, dict[str, Any]] = {}
        self.told: list[str] = []
        self.ended = threading.Event()
        self._uuids: dict[tuple[str, str], str] = {}
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        with suppress(ConnectionClosed):  # the server may have refused the connection
            self.send(_CAMERA)  # viser counts a browser as connected after its first camera message

    def __enter__(self) -> "Looker":
        return self

    def __exit__(self, *_: object) -> None:
        self._socket.close()
        self._thread.join()

    def set(self, label: str, value: Any, kind: str = "") -> None:
        """Does what a hand does: nothing waits for the answer."""
        (uuid,) = (uuid for (name, which), uuid in self._uuids.items() if name == label and kind in which)
        self.send({"type": "GuiUpdateMessage", "uuid": uuid, "updates": {"value": value}})

    def options(self, label: str) -> list[str]:
        """Of a dropdown, as they are now."""
        (uuid,) = (uuid for (name, which), uuid in self._uuids.items() if name == label and "Dropdown" in which)
        return list(self.controls[uuid].get("options", []))

    @property
    def ready(self) -> bool:
        """Whether a scene with motions is shown."""
        return any(name == "Task" for name, _ in self._uuids) and len(self.options("Task")) > 1

    def send(self, message: dict[str, Any]) -> None:
        """Sends a message of viser's protocol."""
        self._socket.send(msgspec.msgpack.encode(message))

    def _listen(self) -> None:
        try:
            for data in self._socket:
                size = int.from_bytes(data[8:16], "little")
                for message in msgspec.msgpack.decode(zstandard.decompress(data[16 : 16 + size]))["messages"]:
                    self._take(message)
        except ConnectionClosed:
            pass  # as when it ends well
        self.ended.set()

    def _take(self, message: dict[str, Any]) -> None:
        if message["type"] == "NotificationShowMessage":
            self.told.append(message["props"]["body"])
        elif message["type"] == "GuiUpdateMessage":
            self.controls.setdefault(message["uuid"], {}).update(message["updates"])
        elif message["type"].startswith("Gui") and isinstance(message.get("props"), dict) and "uuid" in message:
            self.controls.setdefault(message["uuid"], {}).update(message["props"])
            self._uuids[message["props"].get("label", ""), message["type"]] = message["uuid"]
