"""A build of the tiny pipeline, or of another, in a process of its own, so that tests can stop and kill it."""

import os
import sys
from pathlib import Path

from tableverse_factory.core.config import load_config
from tableverse_factory.core.storage.files import parse_path
from workers.driver.signals import StopSignals
from workers.progress.console import OrderedConsole, ProgressDisplay
from workers.run import BuildRequest, run_build


def main() -> None:
    manifest, out, executor, workers, *overrides = sys.argv[1:]
    request = BuildRequest(
        manifest=parse_path(manifest),
        out=parse_path(out),
        config=load_config(None, overrides),
        cache_dir=Path(manifest).parent / "cache",
        executor="ray" if executor == "ray" else "local",
        workers=int(workers) if executor == "ray" else None,
        pipeline=os.environ.get("PIPELINES_OF_TEST", "tests.helpers.tiny_pipeline:PIPELINES"),
    )
    with ProgressDisplay(OrderedConsole(stderr=True)) as progress:
        summary = run_build(request, progress, StopSignals())
    sys.exit(128 + summary.signal if summary.signal else 0)


if __name__ == "__main__":
    main()
