"""Consistency of a trajectory's row with its task, the configuration, and its arrays."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import PurePath
from typing import Any

import numpy as np

from schemas.config import TrajectoriesConfig
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.robotics.execution.arrays import Recording
from tableverse_factory.robotics.execution.execute import MAX_SETTLE_S
from tableverse_factory.robotics.execution.perturbations import PERTURBATIONS

_TOLERANCE = 1e-9  # for values that are written both in the row and in the arrays
_MEASURED_KEYS = ("duration_s", "lifted_m", "disturbed_m", "base_x_m", "base_y_m", "base_z_m", "base_yaw_rad")
Row = Mapping[str, Any]


def find_row_mismatches(
    row: Row, saved: Recording, tasks: Sequence[Row] | None, config: TrajectoriesConfig | None
) -> Iterator[str]:
    """Find contradictions, one line each; unknown `tasks` or `config` are not compared."""
    yield from () if tasks is None else _check_task(row, tasks)
    yield from () if config is None else _check_config(row, saved, config)
    yield from _check_base(row, saved)
    yield from _check_duration(row, saved)
    yield from _check_vocabulary(row)


def _check_task(row: Row, tasks: Sequence[Row]) -> Iterator[str]:
    own = [task for task in tasks if task.get("task_id") == row.get("task_id")]
    if len(own) != 1 or not own[0].get("accepted"):
        yield f"its task stands in tasks/ {len(own)} times" if len(own) != 1 else "its task was refused"
        return
    for key in ("x_id", "y_id", "relation", "instruction"):
        if row.get(key) != own[0].get(key):
            yield f"its row says {key} {_quote(row.get(key))}, its task {_quote(own[0].get(key))}"


def _check_config(row: Row, saved: Recording, config: TrajectoriesConfig) -> Iterator[str]:
    for key in ("robot", "planner", "grasp_model"):
        claimed, known = row.get(key), getattr(config, key)
        if _strip_folder(claimed) != _strip_folder(known):
            yield f"its row says {key} {_quote(claimed)}, run.json {_quote(known)}"
    for key in ("max_disturbed_m", "step_s"):
        if getattr(saved, key) != getattr(config, key):
            yield f"its arrays say {key} {getattr(saved, key):g}, run.json {getattr(config, key):g}"


def _check_base(row: Row, saved: Recording) -> Iterator[str]:
    if _strip_folder(row.get("robot")) != _strip_folder(saved.robot):
        yield f"its row says robot {_quote(row.get('robot'))}, its arrays {_quote(saved.robot)}"
    if missing := [key for key in _MEASURED_KEYS if row.get(key) is None]:
        yield f"its row has no {', '.join(missing)}"
        return
    place = [float(row[key]) for key in ("base_x_m", "base_y_m", "base_z_m")]
    if not np.allclose(np.array(place), saved.base.position, 0.0, _TOLERANCE):
        yield f"its row puts the base at {place!r:.100}, its arrays at {saved.base.position.tolist()}"
    w, x, y, z = saved.base.quaternion_wxyz
    half = float(row["base_yaw_rad"]) / 2
    if not (abs(np.cos(half) * z - np.sin(half) * w) <= _TOLERANCE and np.hypot(x, y) <= _TOLERANCE):
        yield f"its row turns the base by {2 * half:.4f} rad, its arrays by {2 * np.arctan2(z, w):.4f} rad upright"


def _check_duration(row: Row, saved: Recording) -> Iterator[str]:
    """Check that the arrays hold the motion and the wait for rest; those of a failure may end earlier."""
    if row.get("duration_s") is None:
        return
    duration_s, last = float(row["duration_s"]), len(saved) - 1
    end = duration_s / saved.step_s
    whole = np.isfinite(end) and abs(end - np.rint(end)) <= 1e-6 * max(1.0, end)
    waits = end + round(MAX_SETTLE_S / saved.step_s) >= last - 1e-3
    if not (whole and waits and (end <= last + 1e-3 or not row.get("success"))):
        yield f"its row says that the motion takes {duration_s:.3f} s, its arrays hold {last * saved.step_s:.3f} s"
    elif (saved.command[int(np.rint(min(end, last))) :] != saved.command[-1]).any():
        yield f"its row says that the motion takes {duration_s:.3f} s, its arrays go on after that"


def _check_vocabulary(row: Row) -> Iterator[str]:
    survives, success = row.get("survives"), bool(row.get("success"))
    if success != (survives is not None):
        yield "it succeeded, and survives says nothing" if success else "it failed, and survives something"
    elif survives is not None and survives != [name for name in PERTURBATIONS if name in survives]:
        yield f"survives is {_quote(survives)}, and there are {', '.join(PERTURBATIONS)}, each once, in this order"
    if row.get("grasp_stage") not in (1, 2, 3):
        yield f"grasp_stage is {_quote(row.get('grasp_stage'))}, and there are 1, 2 and 3"
    if success and (said := [key for key in ("failed_phase", "reason", "detail") if row.get(key) is not None]):
        yield f"it succeeded, and its row has a {said[0]}"


def _strip_folder(name: object) -> object:
    """Reduce a robot's file to its name, as folders differ between machines."""
    return PurePath(name).name if isinstance(name, str) and name.endswith(".xml") else name


def _quote(value: object) -> str:
    return sanitize_line(repr(value), 80)
