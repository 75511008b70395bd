"""Who writes a dataset: how a process names itself in a lock, and how a lock names it to people."""

import json
import os
import platform
from dataclasses import asdict, dataclass
from pathlib import Path

from tableverse_factory.core.storage.files import StoragePath

_MAX_HOST_CHARS = 100
_BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True, slots=True)
class LockOwner:
    """A process.

    Attributes:
        world: What its number is unique in: one start of a machine, one process namespace of it; empty if unknown.
        started: When it started, in the kernel's ticks: numbers are used again.
    """

    pid: int
    host: str
    world: str = ""
    started: int = 0

    @property
    def is_dead(self) -> bool:
        """Whether it is known to have ended: only from the same world can that be seen."""
        return bool(self.world) and self.world == _world() and _started(self.pid) != self.started

    def message(self, out: StoragePath) -> str:
        """That it holds the dataset, and what to do."""
        how = f" (kill {self.pid})" if self.host == platform.node() else ""
        return (
            f"{out} is being written by process {self.pid} on {self.host}: wait for it, or stop it{how} "
            "and run this again"
        )


def this_process() -> LockOwner:
    """The process that asks."""
    pid = os.getpid()
    return LockOwner(pid, platform.node(), _world(), _started(pid))


def encode_holder(holder: LockOwner, **more: object) -> bytes:
    """As JSON, with what else a lock holds."""
    return json.dumps({**asdict(holder), **more}).encode()


def decode_holder(data: bytes) -> LockOwner | None:
    """The holder in a lock; None where it says none: it may be half written."""
    try:
        found = json.loads(data)
        host = "".join(c for c in str(found["host"])[:_MAX_HOST_CHARS] if c.isprintable())
        return LockOwner(int(found["pid"]), host, str(found.get("world", "")), int(found.get("started", 0)))
    except (ValueError, KeyError, TypeError):
        return None


def held_by(out: StoragePath, data: bytes) -> str:
    """The sentence for a lock with this content."""
    holder = decode_holder(data)
    if holder is None:
        return f"{out} is being written by another process: wait for it, or stop it and run this again"
    return holder.message(out)


def _world() -> str:
    try:
        return f"{_BOOT_ID.read_text().strip()}/{os.stat('/proc/self/ns/pid').st_ino}"  # noqa: PTH116 a magic link
    except OSError:
        return ""


def _started(pid: int) -> int:
    """Field 22 of /proc/PID/stat; 0 where there is no such process."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return 0
    return int(text.rpartition(")")[2].split()[19])
