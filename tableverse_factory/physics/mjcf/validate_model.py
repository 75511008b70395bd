"""Models that MuJoCo loads and nothing can be measured on: numbers that are none, steps that are no time."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np

from tableverse_factory.core.errors import InputError

LEAST_STEP_S, MOST_STEP_S = 1e-5, 0.05
"""Shorter steps take hours for the certificate's time; longer ones leave fewer than two between its nudges [s]."""


@contextmanager
def raise_on_nan() -> Iterator[None]:
    """While a model is loaded inside: a NaN for which MuJoCo takes its default with a warning is refused.

    Raises:
        InputError: `bad_mjcf`.
    """
    said: list[str] = []  # MuJoCo would write its warnings into a log file in the current folder
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(said.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
    if any("NaN" in warning for warning in said):
        raise InputError("it holds a NaN: give finite numbers", "bad_mjcf")


def check_finite(model: mujoco.MjModel) -> None:
    """Nothing, where every number of a model is one: MuJoCo itself puts up with NaN and infinity in most places.

    Raises:
        InputError: `bad_mjcf`, with an array of the model that holds another.
    """
    found = []
    for place, holder in (("", model), ("option.", model.opt)):
        for name in (name for name in dir(holder) if not name.startswith("_")):
            value: Any = getattr(holder, name)
            if isinstance(value, float | np.ndarray) and np.asarray(value).dtype.kind == "f":
                wrong = np.ravel(value)[~np.isfinite(np.ravel(value))]
                found += [(bool(np.isnan(wrong[0])), f"{place}{name} holds {wrong[0]}")] if wrong.size else []
    if found:  # what was computed from an infinity is no number: the infinity is what somebody wrote
        raise InputError(f"{min(found)[1]}: give finite numbers", "bad_mjcf")


def check_time_step(model: mujoco.MjModel) -> None:
    """Nothing, where the certificate's seconds are a number of steps that shows something and ends.

    Raises:
        InputError: `bad_mjcf`.
    """
    step = float(model.opt.timestep)
    if not LEAST_STEP_S <= step <= MOST_STEP_S:
        raise InputError(
            f"the timestep is {step:g} s; drift is measured with {LEAST_STEP_S:g} to {MOST_STEP_S:g} s", "bad_mjcf"
        )
