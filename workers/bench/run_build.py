"""A build of any pipeline in a process of its own with progress on stdout, for `tableverse bench factory`.

`python -m workers.bench.run_build MANIFEST OUT EXECUTOR WORKERS PIPELINE` writes a line `seconds scenes cpu_s bytes`
about once a second, and one at the end: seconds of the monotonic clock, which all processes of a machine share,
finished scenes, CPU time of the driver, and bytes that it read, wrote and exchanged with actors.
"""

import sys
import time
from pathlib import Path

from schemas.config import Config
from workers.driver.signals import StopSignals
from workers.progress.tally import Tally
from workers.run import BuildRequest, run_build

_EVERY_S = 1.0


class StdoutProgress:
    """Progress display that writes lines of time and number of finished scenes."""

    def __init__(self) -> None:
        self._next = 0.0
        self._written = -1

    def show(self, tally: Tally) -> None:
        """Write a line after a change, about once a second, and after the last one."""
        ready = time.monotonic() >= self._next or tally.accounted == tally.total
        if ready and tally.accounted != self._written:
            self._next = time.monotonic() + _EVERY_S
            self.write(tally)

    def note(self, line: str) -> None:
        """Write a note to stderr."""
        sys.stderr.write(f"{line}\n")

    def write(self, tally: Tally) -> None:
        """Write a line."""
        self._written = tally.accounted
        moved = tally.bytes_exchanged + _count_io()
        sys.stdout.write(f"{time.monotonic():.3f} {tally.accounted} {time.process_time():.3f} {moved}\n")
        sys.stdout.flush()


def _count_io() -> int:
    """Count the bytes that this process has read and written."""
    counters = dict(line.split(": ") for line in Path("/proc/self/io").read_text().splitlines())
    return int(counters["rchar"]) + int(counters["wchar"])


def main() -> None:
    """Run the build; exit code 0 if it completes."""
    manifest, out, executor, workers, pipeline = sys.argv[1:]
    request = BuildRequest(
        manifest=Path(manifest),
        out=Path(out),
        config=Config(),
        cache_dir=Path(out).parent / "cache",
        executor="ray" if executor == "ray" else "local",
        workers=int(workers) if executor == "ray" else None,
        pipeline=pipeline,
    )
    progress = StdoutProgress()
    summary = run_build(request, progress, StopSignals())
    progress.write(summary.tally)
    sys.exit(128 + summary.signal if summary.signal else 0)


if __name__ == "__main__":
    main()
