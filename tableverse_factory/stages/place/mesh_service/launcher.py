"""Starts the command of a mesh process and sees to its end: `mesh_launch.py PARENT COMMAND…`, plain Python.

The command may be a wrapper (a shell, an environment's launcher, a container's client) that starts the process proper.
When whoever asked for it dies, even by `kill -9`, or the command ends, all below is killed, whatever its session:
nothing may go on holding a GPU that nobody asks any more. The command inherits stdin and stdout; here they are closed.
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
    """Runs the command to its end, and ends as it did."""
    parent, command = int(sys.argv[1]), sys.argv[2:]
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a Ctrl-C is for the parent, whose end is ours
    signal.signal(signal.SIGTERM, _end)
    kernel = ctypes.CDLL(None)
    kernel.prctl(_PR_SET_CHILD_SUBREAPER, 1)
    kernel.prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != parent:
        sys.exit(1)
    child = os.fork()
    if child == 0:
        _become(command, kernel)
    os.close(0)
    os.close(1)
    status = _waited(child)
    _kill_all_below()
    if os.WIFSIGNALED(status):
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), os.WTERMSIG(status))
    os._exit(os.waitstatus_to_exitcode(status))


def _become(command: list[str], kernel: ctypes.CDLL) -> NoReturn:
    """Is the command, which is killed when this program is: then nobody is left to do it."""
    kernel.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    try:
        os.execvp(command[0], command)  # noqa: S606 as it is given
    except OSError as error:
        os.write(2, f"{command[0]}: {error.strerror}\n".encode(errors="replace"))
    os._exit(1)


def _waited(child: int) -> int:
    """The status of the child; orphans that end meanwhile are reaped."""
    while True:
        pid, status = os.waitpid(-1, 0)
        if pid == child:
            return status


def _end(*_: object) -> NoReturn:
    _kill_all_below()
    os._exit(1)


def _kill_all_below() -> None:
    """Kills every descendant: again and again, for what they start until they are dead."""
    while below := _below(os.getpid()):
        for pid in below:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        with suppress(ChildProcessError):
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass


def _below(root: int) -> set[int]:
    """All descendants, by the kernel's list of processes; their orphans are ours."""
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
