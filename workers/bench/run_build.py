"""A build of any pipeline in a process of its own with progress on stdout, for `tableverse bench factory`.

`python -m workers.bench.run_build MANIFEST OUT EXECUTOR WORKERS PIPELINE` writes a line `seconds scenes cpu_s bytes`
about once a second, and one at the end: seconds of the monotonic clock, which all processes of a machine share,
finished scenes, CPU time of the driver, and bytes that passed through it. Exit code 1 if a scene is not done.
"""

import sys
import time
from pathlib import Path

from schemas.config import Config
from workers.bench.traffic import TrafficMeter
from workers.driver.signals import StopSignals
from workers.progress.tally import Tally
from workers.run import BuildRequest, run_build

_EVERY_S = 1.0


class StdoutProgress:
    """Progress display that writes lines of time and number of finished scenes."""

    def __init__(self, meter: TrafficMeter) -> None:
        self._meter = meter
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
        figures = (f"{time.monotonic():.3f}", tally.accounted, f"{time.process_time():.3f}", self._meter.count())
        sys.stdout.write(" ".join(map(str, figures)) + "\n")
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
    progress = StdoutProgress(TrafficMeter(with_ray=executor == "ray"))
    summary = run_build(request, progress, StopSignals())
    progress.write(summary.tally)
    if summary.signal:
        sys.exit(128 + summary.signal)
    if summary.tally.count("done") < summary.tally.total:
        sys.exit(str(summary))


if __name__ == "__main__":
    main()
