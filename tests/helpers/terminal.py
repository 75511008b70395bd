"""A command in a real pseudo-terminal, and what a person saw of it."""

import fcntl
import os
import pty
import select
import signal
import struct
import termios
import time
from collections.abc import Mapping
from dataclasses import dataclass

import pyte

from tests.helpers.paths import ROOT

PLAIN = {key: value for key, value in os.environ.items() if key not in ("NO_COLOR", "FORCE_COLOR", "COLUMNS", "LINES")}


@dataclass
class Seen:
    """What a person had before the eyes at the end, what had scrolled away, and the bytes of all of it."""

    code: int
    screen: list[str]
    scrolled: list[str]
    raw: bytes
    looks: list[list[str]]
    cursor_hidden: bool


def watch(
    command: list[str],
    size: tuple[int, int] = (100, 30),
    environment: Mapping[str, str] = {},
    at: float | None = None,
    then: int | None = None,
    resize: tuple[int, int] | None = None,
) -> Seen:
    """Runs a command in a terminal of (columns, rows); `at` seconds after its first word, a signal or another size."""
    pid, terminal = pty.fork()
    if pid == 0:
        os.chdir(ROOT)
        signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell that runs the tests in the background ignores it
        os.execvpe(command[0], command, {**PLAIN, "TERM": "xterm-256color", **environment})  # noqa: S606 no shell
    columns, rows = size
    fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
    screen = pyte.HistoryScreen(columns, rows, history=10_000)
    stream, raw, looks, first = pyte.ByteStream(screen), b"", [], None
    while True:
        if select.select([terminal], [], [], 0.05)[0]:
            try:
                data = os.read(terminal, 65536)
            except OSError:  # Linux says so where others say end of file
                break
            raw += data
            for line in data.splitlines(keepends=True):  # on a busy machine a read has several drawings
                stream.feed(line)
                looks.append(_look_at(screen))
            first = first or time.monotonic()
        if first and at is not None and time.monotonic() - first > at:
            at = None
            if then is not None:
                os.kill(pid, then)
            if resize is not None:
                fcntl.ioctl(terminal, termios.TIOCSWINSZ, struct.pack("HHHH", resize[1], resize[0], 0, 0))
                screen.resize(resize[1], resize[0])
    code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
    os.close(terminal)
    return Seen(
        code,
        _look_at(screen),
        [text_of(line, columns) for line in screen.history.top],
        raw,
        looks,
        pyte.modes.DECTCEM not in screen.mode,
    )


def _look_at(screen: pyte.Screen) -> list[str]:
    return [line.rstrip() for line in screen.display if line.strip()]


def text_of(line: Mapping[int, pyte.screens.Char], columns: int) -> str:
    return "".join(line[column].data for column in range(columns)).rstrip()
