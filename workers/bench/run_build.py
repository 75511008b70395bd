"""A build of any pipeline in a process of its own with progress on stdout, for `tableverse bench factory`.

`python -m workers.bench.run_build MANIFEST OUT EXECUTOR WORKERS PIPELINE` writes a line `seconds scenes` about once a
second, and one at the end. Seconds are of the monotonic clock, which all processes of a machine share.
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
        """Write a line after a change, about once a second."""
        if time.monotonic() >= self._next and tally.accounted != self._written:
            self._next = time.monotonic() + _EVERY_S
            self.write(tally.accounted)

    def note(self, line: str) -> None:
        """Write a note to stderr."""
        sys.stderr.write(f"{line}\n")

    def write(self, scenes: int) -> None:
        """Write a line."""
        self._written = scenes
        sys.stdout.write(f"{time.monotonic():.3f} {scenes}\n")
        sys.stdout.flush()


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
    progress.write(summary.tally.accounted)
    sys.exit(128 + summary.signal if summary.signal else 0)


if __name__ == "__main__":
    main()
