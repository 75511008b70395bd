"""A command of `tableverse` on the longer tiny line, in a process of its own, so that tests can kill it."""

import sys

from tableverse_factory.cli.main import main
from workers import run

run.PIPELINE, run.WITH_TRAJECTORIES = "tests.helpers.longer_line:SHORT", "tests.helpers.longer_line:LONG"

if __name__ == "__main__":
    sys.argv[0] = "tableverse"
    main()
