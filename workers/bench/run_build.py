"""A build of any line in a process of its own that says on stdout how far it is: what `tableverse bench factory` runs.

`python -m workers.bench.run_build MANIFEST OUT EXECUTOR WORKERS PIPELINE`; a line `seconds scenes` about once a second, then one
at the end. Seconds are those of the monotonic clock, which all processes of a machine share.
"""

import sys
import time
from pathlib import Path

from schemas.config import Config
from workers.driver.signals import StopSignals
from workers.progress.tally import Tally
from workers.run import BuildRequest, run_build

_EVERY_S = 1.0


class Pace:
    """A display that writes down how many scenes are accounted for, and when."""

    def __init__(self) -> None:
        self._next = 0.0
        self._said = -1

    def show(self, tally: Tally) -> None:
        """Writes a line, about once a second and where something has changed."""
        if time.monotonic() >= self._next and tally.accounted != self._said:
            self._next = time.monotonic() + _EVERY_S
            self.say(tally.accounted)

    def note(self, line: str) -> None:
        """Goes to stderr."""
        sys.stderr.write(f"{line}\n")

    def say(self, scenes: int) -> None:
        """Writes a line."""
        self._said = scenes
        sys.stdout.write(f"{time.monotonic():.3f} {scenes}\n")
        sys.stdout.flush()


def main() -> None:
    """Runs the build; exit code 0 where it is complete."""
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
    pace = Pace()
    summary = run_build(request, pace, StopSignals())
    pace.say(summary.tally.accounted)
    sys.exit(128 + summary.signal if summary.signal else 0)


if __name__ == "__main__":
    main()
