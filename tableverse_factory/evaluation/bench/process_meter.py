"""A command watched from outside: CPU time of its whole family of processes, memory of the first one, what it says."""

import os
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import psutil

from tableverse_factory.core.errors import BuildError

_LOOK_S = 0.5
_MB = 1_000_000
_LAST_CHARS = 2000


@dataclass(frozen=True, slots=True)
class Watched:
    """What was seen of one command.

    Attributes:
        lines: What it wrote on stdout: pairs (monotonic time [s], count).
        memory: Resident memory of its first process: pairs (monotonic time [s], memory [MB]).
        cpu_s: CPU time by kind of process [s].
    """

    lines: tuple[tuple[float, int], ...]
    memory: tuple[tuple[float, float], ...]
    cpu_s: Mapping[str, float]


def watch(command: Sequence[str], environment: Mapping[str, str], kind_of: Callable[[str], str]) -> Watched:
    """Runs a command to its end and looks at its processes twice a second; what it uses after the last look is lost.

    Args:
        command: It writes lines `seconds count` on stdout, seconds of the monotonic clock.
        environment: Beside this process's own.
        kind_of: Names the kind of a process below the first one from its command line.

    Raises:
        BuildError: if the command ends with another exit code than 0, with its last words.
    """
    cpu: dict[tuple[int, float], tuple[str, float]] = {}
    memory: list[tuple[float, float]] = []
    with tempfile.TemporaryFile("w+") as said, tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(command, stdout=said, stderr=errors, env={**os.environ, **environment})
        try:
            first = psutil.Process(process.pid)
            while process.poll() is None:
                _look(first, kind_of, cpu, memory)
                time.sleep(_LOOK_S)
        finally:
            process.kill()
            process.wait()
        said.seek(0)
        errors.seek(0)
        if process.returncode != 0:
            raise BuildError(
                f"{' '.join(command[1:4])} … ended with {process.returncode}: {errors.read()[-_LAST_CHARS:]}"
            )
        lines = tuple((float(seconds), int(count)) for seconds, count in map(str.split, said))
    total: Counter[str] = Counter()
    for kind, seconds in cpu.values():
        total[kind] += seconds  # type: ignore[assignment]
    return Watched(lines, tuple(memory), dict(total))


def python(module: str, *arguments: object) -> list[str]:
    """The command that runs a module of ours."""
    return [sys.executable, "-m", module, *map(str, arguments)]


def _look(
    first: psutil.Process,
    kind_of: Callable[[str], str],
    cpu: dict[tuple[int, float], tuple[str, float]],
    memory: list[tuple[float, float]],
) -> None:
    try:
        memory.append((time.monotonic(), first.memory_info().rss / _MB))
        family = [first, *first.children(recursive=True)]
    except psutil.Error:  # it has just ended
        return
    for process in family:
        try:
            with process.oneshot():
                key, times = (process.pid, process.create_time()), process.cpu_times()
                command = " ".join(process.cmdline())
        except psutil.Error:
            continue
        # A worker of Ray changes its title, so the last one counts; a process that is ending has none.
        kind = "driver" if process.pid == first.pid else kind_of(command) if command else cpu.get(key, ("", 0.0))[0]
        cpu[key] = (kind, times.user + times.system)
