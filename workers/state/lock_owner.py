"""Identity of the process that writes a dataset, as a lock stores it and shows it to people."""

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
    """A process."""

    pid: int
    host: str
    pid_namespace: str = ""  # boot and process namespace within which `pid` is unique; empty if unknown
    started: int = 0  # start time in kernel ticks, since process ids are reused

    @property
    def is_dead(self) -> bool:
        """Whether it is known to have ended, which only processes of its namespace can see."""
        return (
            bool(self.pid_namespace)
            and self.pid_namespace == _read_pid_namespace()
            and _read_start_time(self.pid) != self.started
        )


def identify_process() -> LockOwner:
    """Identify the current process."""
    pid = os.getpid()
    return LockOwner(pid, platform.node(), _read_pid_namespace(), _read_start_time(pid))


def encode_owner(owner: LockOwner, **more: object) -> bytes:
    """Encode an owner as JSON, with further values of a lock."""
    return json.dumps({**asdict(owner), **more}).encode()


def decode_owner(data: bytes) -> LockOwner | None:
    """Decode the owner in a lock; None if there is none, since a lock may be half written."""
    try:
        found = json.loads(data)
        host = "".join(c for c in str(found["host"])[:_MAX_HOST_CHARS] if c.isprintable())
        namespace, started = str(found.get("pid_namespace", "")), int(found.get("started", 0))
        return LockOwner(int(found["pid"]), host, namespace, started)
    except (ValueError, KeyError, TypeError):
        return None


def describe_owner(data: bytes) -> str:
    """Describe who holds a lock with this content."""
    owner = decode_owner(data)
    return "another process" if owner is None else f"process {owner.pid} on {owner.host}"


def explain_refusal(out: StoragePath, data: bytes) -> str:
    """Explain to another writer who holds the lock of `out`, and what to do."""
    owner = decode_owner(data)
    how = f" (kill {owner.pid})" if owner is not None and owner.host == platform.node() else ""
    return f"{out} is being written by {describe_owner(data)}: wait for it, or stop it{how} and run this again"


def _read_pid_namespace() -> str:
    try:
        return f"{_BOOT_ID.read_text().strip()}/{os.stat('/proc/self/ns/pid').st_ino}"  # noqa: PTH116 a magic link
    except OSError:
        return ""


def _read_start_time(pid: int) -> int:
    """Read field 22 of /proc/PID/stat; 0 if there is no such process."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return 0
    return int(text.rpartition(")")[2].split()[19])
