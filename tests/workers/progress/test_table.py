"""What the line of a log says before and after the first scene is back."""

from workers.progress.eta import ProgressRate
from workers.progress.table import format_log_line
from workers.progress.tally import Actors, Tally

STAGES = ("manifest", "observe", "place", "export")


def test_a_call_is_named_by_where_it_began_and_only_once():
    """A call runs through several stages: which of them it is in, nobody tells us."""
    tally, pace = Tally(STAGES, total=4, before=0, shards=1), ProgressRate()
    pace.update(0.0, tally)
    assert "waiting for the first scene, 3 s so far" in format_log_line(tally, pace, 3.0)
    tally.actors = {"all": Actors(0, 1)}
    assert "waiting for the first worker" in format_log_line(tally, pace, 3.0)
    tally.running["observe"] = 2
    line = format_log_line(tally, pace, 31.0)
    assert "0/4 scenes, no scene is back yet; in work: 2 from observe, 31 s so far" in line
    assert line.count("observe") == 1
    tally.record_call("observe", 1.0, 1.0)
    tally.ended["export", "done"] += 1
    assert format_log_line(tally, pace, 40.0).endswith("; in work: 2 from observe")
