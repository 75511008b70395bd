"""What the row of a trajectory claims beside what it was made from: its task, the configuration, and its arrays."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np

from schemas.config import TrajectoriesConfig
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.robotics.execution.execute import REST_S
from tableverse_factory.robotics.execution.perturbations import CHANGES

_EXACT = 1e-9
"""Of what is written twice, in the row and in the arrays."""

_ASKED = ("x_id", "y_id", "relation", "instruction")
_CONFIGURED = ("robot", "planner", "grasp_model")
_MEASURED = ("duration_s", "lifted_m", "disturbed_m", "base_x_m", "base_y_m", "base_z_m", "base_yaw_rad")
_FAILED = ("failed_phase", "reason", "detail")
_STAGES = (1, 2, 3)

Row = Mapping[str, Any]


def row_mismatches(
    row: Row, saved: Recording, tasks: Sequence[Row] | None, config: TrajectoriesConfig | None
) -> Iterator[str]:
    """What is wrong; one line each.

    Args:
        row: Of trajectories/, with arrays.
        saved: Its arrays.
        tasks: Rows of tasks/ of the scene; None where nobody knows them.
        config: What the trajectories were made with; None where nobody knows it.
    """
    yield from () if tasks is None else _task(row, tasks)
    yield from () if config is None else _configured(row, saved, config)
    yield from _base(row, saved)
    yield from _duration(row, saved)
    yield from _vocabulary(row)


def _task(row: Row, tasks: Sequence[Row]) -> Iterator[str]:
    own = [task for task in tasks if task.get("task_id") == row.get("task_id")]
    if len(own) != 1 or not own[0].get("accepted"):
        yield f"its task stands in tasks/ {len(own)} times" if len(own) != 1 else "its task was refused"
        return
    for key in _ASKED:
        if row.get(key) != own[0].get(key):
            yield f"its row says {key} {_shown(row.get(key))}, its task {_shown(own[0].get(key))}"


def _configured(row: Row, saved: Recording, config: TrajectoriesConfig) -> Iterator[str]:
    for key in _CONFIGURED:
        claimed, known = row.get(key), getattr(config, key)
        if _named(claimed) != _named(known):
            yield f"its row says {key} {_shown(claimed)}, run.json {_shown(known)}"
    for key in ("max_disturbed_m", "step_s"):
        if getattr(saved, key) != getattr(config, key):
            yield f"its arrays say {key} {getattr(saved, key):g}, run.json {getattr(config, key):g}"


def _base(row: Row, saved: Recording) -> Iterator[str]:
    if _named(row.get("robot")) != _named(saved.robot):
        yield f"its row says robot {_shown(row.get('robot'))}, its arrays {_shown(saved.robot)}"
    if missing := [key for key in _MEASURED if row.get(key) is None]:
        yield f"its row has no {', '.join(missing)}"
        return
    place = [float(row[key]) for key in ("base_x_m", "base_y_m", "base_z_m")]
    if not np.allclose(np.array(place), saved.base.position, 0.0, _EXACT):
        yield f"its row puts the base at {place!r:.100}, its arrays at {saved.base.position.tolist()}"
    w, x, y, z = saved.base.quaternion_wxyz
    half = float(row["base_yaw_rad"]) / 2
    if not (abs(np.cos(half) * z - np.sin(half) * w) <= _EXACT and np.hypot(x, y) <= _EXACT):
        yield f"its row turns the base by {2 * half:.4f} rad, its arrays by {2 * np.arctan2(z, w):.4f} rad upright"


def _duration(row: Row, saved: Recording) -> Iterator[str]:
    """The arrays hold the motion and the wait for rest after it; those of a failure may end before."""
    if row.get("duration_s") is None:
        return
    duration_s, last = float(row["duration_s"]), len(saved) - 1
    end = duration_s / saved.step_s
    fits = np.isfinite(end) and abs(end - np.rint(end)) <= 1e-6 * max(1.0, end)
    fits = fits and end + round(REST_S / saved.step_s) >= last - 1e-3 and (end <= last + 1e-3 or not row.get("success"))
    if not fits:
        yield f"its row says that the motion takes {duration_s:.3f} s, its arrays hold {last * saved.step_s:.3f} s"
    elif (saved.command[int(np.rint(min(end, last))) :] != saved.command[-1]).any():
        yield f"its row says that the motion takes {duration_s:.3f} s, its arrays go on after that"


def _vocabulary(row: Row) -> Iterator[str]:
    survives, success = row.get("survives"), bool(row.get("success"))
    if success != (survives is not None):
        yield "it succeeded, and survives says nothing" if success else "it failed, and survives something"
    elif survives is not None and survives != [name for name in CHANGES if name in survives]:
        yield f"survives is {_shown(survives)}, and there are {', '.join(CHANGES)}, each once, in this order"
    if row.get("grasp_stage") not in _STAGES:
        yield f"grasp_stage is {_shown(row.get('grasp_stage'))}, and there are 1, 2 and 3"
    if success and (said := [key for key in _FAILED if row.get(key) is not None]):
        yield f"it succeeded, and its row has a {said[0]}"


def _named(name: object) -> object:
    """A robot from a file by that file's name: folders differ from machine to machine."""
    return PurePath(name).name if isinstance(name, str) and name.endswith(".xml") else name


def _shown(value: object) -> str:
    return sanitize_line(repr(value), 80)
