"""A command of `tableverse` on the long tiny pipeline, in a process of its own, so that tests can kill it."""

import sys

from tableverse_factory.cli.main import main
from workers import run

run.PIPELINE, run.WITH_TRAJECTORIES = "tests.helpers.long_pipeline:SHORT", "tests.helpers.long_pipeline:LONG"

if __name__ == "__main__":
    sys.argv[0] = "tableverse"
    main()
