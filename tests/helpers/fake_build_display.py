"""A build that only pretends, for the tests of the display: a second of counting, then the end that was asked for."""

import sys
import time

from rich.console import Console, ConsoleOptions, RenderResult
from rich.live_render import LiveRender

from workers.progress.console import OrderedConsole, ProgressDisplay
from workers.progress.tally import Actors, Tally

STAGES = ("manifest", "observe", "perceive", "place", "rectify", "settle", "curate", "export")


def _draw_slowly() -> None:
    """Draw as on a busy machine: another thread may print between the start of a drawing and its end."""
    draw = LiveRender.__rich_console__

    def draw_late(self: LiveRender, console: Console, options: ConsoleOptions) -> RenderResult:
        time.sleep(0.05)
        yield from draw(self, console, options)

    LiveRender.__rich_console__ = draw_late


def main() -> None:
    wait_s, end = float(sys.argv[1]), sys.argv[2]
    if end == "slow":
        _draw_slowly()
    tally = Tally(STAGES, total=400, before=0, shards=4)
    with ProgressDisplay(OrderedConsole(stderr=True)) as progress:
        progress.note("starting Ray on this machine …")
        time.sleep(wait_s)
        tally.actors = {"perception": Actors(1, 2), "physics": Actors(2, 2)}
        tally.running["observe"] = 2
        for step in range(200):
            for stage in STAGES[1:]:
                tally.record_call(stage, 0.02, 0.05)
                tally.passed[stage] += stage != "export"
            tally.ended["export", "done"] += 1
            tally.ended["settle", "dropped"] += step % 10 == 0
            if step % 5 == 0:
                progress.note(f"scene_{step}: settle failed: \x1b[31mTypeError: {'x' * 300}")
                if end == "slow":
                    sys.stderr.write("a warning of a library\n")
            progress.show(tally)
            if step == 150 and end == "error":
                raise ValueError("the disk is full")
            time.sleep(0.005)
    sys.stdout.write("out\n")


if __name__ == "__main__":
    main()
