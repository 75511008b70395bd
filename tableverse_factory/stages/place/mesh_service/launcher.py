"""Launcher of a mesh process that kills all of its descendants at the end: `launcher.py PARENT COMMAND…`.

The command may be a wrapper (a shell, an environment's launcher, a container's client) that starts the actual process.
When the parent dies, even by `kill -9`, or the command ends, all descendants are killed, whatever their session, so
that none keeps a GPU. The command inherits stdin and stdout; the launcher closes its own. Imports only Python itself.
"""

import ctypes
import os
import signal
import sys
from contextlib import suppress
from pathlib import Path
from typing import NoReturn

_PR_SET_PDEATHSIG, _PR_SET_CHILD_SUBREAPER = 1, 36


def main() -> NoReturn:
    """Run the command to its end, and exit with its status."""
    parent, command = int(sys.argv[1]), sys.argv[2:]
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent, whose end ends us
    signal.signal(signal.SIGTERM, _terminate)
    kernel = ctypes.CDLL(None)
    kernel.prctl(_PR_SET_CHILD_SUBREAPER, 1)
    kernel.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        sys.exit(1)
    child = os.fork()
    if child == 0:
        _exec_command(command, kernel)
    os.close(0)
    os.close(1)
    pid = status = 0
    while pid != child:  # orphans that end meanwhile are reaped
        pid, status = os.waitpid(-1, 0)
    _kill_descendants()
    if os.WIFSIGNALED(status):
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), os.WTERMSIG(status))
    os._exit(os.waitstatus_to_exitcode(status))


def _exec_command(command: list[str], kernel: ctypes.CDLL) -> NoReturn:
    """Replace this process by the command, which the kernel kills with the launcher."""
    kernel.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        os.execvp(command[0], command)  # noqa: S606 no shell
    except OSError as error:
        os.write(2, f"{command[0]}: {error.strerror}\n".encode(errors="replace"))
    os._exit(1)


def _terminate(*_: object) -> NoReturn:
    _kill_descendants()
    os._exit(1)


def _kill_descendants() -> None:
    """Kill all descendants, repeatedly, for they may start others until they are dead."""
    while descendants := _find_descendants(os.getpid()):
        for pid in descendants:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass


def _find_descendants(root: int) -> set[int]:
    """Find all descendants in /proc; as their subreaper this process adopts their orphans."""
    parents: dict[int, int] = {}
    for path in Path("/proc").iterdir():
        if path.name.isdecimal():
            with suppress(OSError):
                parents[int(path.name)] = int((path / "stat").read_text().rpartition(")")[2].split()[1])
    found: set[int] = set()
    while new := {pid for pid, parent in parents.items() if parent in {root, *found}} - found:
        found |= new
    return found


if __name__ == "__main__":
    main()
