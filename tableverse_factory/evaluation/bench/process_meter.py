"""Measurement of a command from outside: CPU time of its process tree, memory of its main process, its output."""

import os
import subprocess
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
class CommandMeasurement:
    """Measurement of one command."""

    lines: tuple[tuple[float, ...], ...]  # numbers on stdout, the first of each line the monotonic time [s]
    memory: tuple[tuple[float, float], ...]  # resident memory of the main process: monotonic time [s], memory [MB]
    cpu_s: Mapping[str, float]  # CPU time by kind of process [s]


def measure_command(
    command: Sequence[str], environment: Mapping[str, str], kind_of: Callable[[str], str]
) -> CommandMeasurement:
    """Run a command to its end and sample its processes twice a second; usage after the last sample is lost.

    Args:
        command: It writes lines of numbers to stdout, first the seconds of the monotonic clock.
        environment: Added to that of this process.
        kind_of: Returns the kind of a child process for its command line.

    Raises:
        BuildError: if the exit code is not 0, with the end of stderr.
    """
    cpu: dict[tuple[int, float], tuple[str, float]] = {}
    memory: list[tuple[float, float]] = []
    with tempfile.TemporaryFile("w+") as output, tempfile.TemporaryFile("w+") as errors:
        process = subprocess.Popen(command, stdout=output, stderr=errors, env={**os.environ, **environment})
        try:
            first = psutil.Process(process.pid)
            while process.poll() is None:
                _sample(first, kind_of, cpu, memory)
                time.sleep(_LOOK_S)
        finally:
            process.kill()
            process.wait()
        output.seek(0)
        errors.seek(0)
        if process.returncode != 0:
            raise BuildError(
                f"{' '.join(command[1:4])} … ended with {process.returncode}: {errors.read()[-_LAST_CHARS:]}"
            )
        lines = tuple(tuple(map(float, line.split())) for line in output)
    total: Counter[str] = Counter()
    for kind, seconds in cpu.values():
        total[kind] += seconds  # type: ignore[assignment]
    return CommandMeasurement(lines, tuple(memory), dict(total))


def _sample(
    first: psutil.Process,
    kind_of: Callable[[str], str],
    cpu: dict[tuple[int, float], tuple[str, float]],
    memory: list[tuple[float, float]],
) -> None:
    try:
        memory.append((time.monotonic(), first.memory_info().rss / _MB))
        family = [first, *first.children(recursive=True)]
    except psutil.Error:  # the process has just ended
        return
    for process in family:
        try:
            with process.oneshot():
                key, times = (process.pid, process.create_time()), process.cpu_times()
                command = " ".join(process.cmdline())
        except psutil.Error:
            continue
        # A Ray worker changes its title, so the last one counts; a process that is ending has none.
        kind = "driver" if process.pid == first.pid else kind_of(command) if command else cpu.get(key, ("", 0.0))[0]
        cpu[key] = (kind, times.user + times.system)
