"""Checks of models that MuJoCo loads but cannot simulate meaningfully: non-finite numbers, bad time steps."""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco
import numpy as np

from tableverse_factory.core.errors import InputError

# Shorter steps take hours for the certificate; longer ones leave fewer than two between its nudges [s].
MIN_STEP_S, MAX_STEP_S = 1e-5, 0.05


@contextmanager
def raise_on_nan() -> Iterator[None]:
    """Refuse a NaN in a model that is loaded inside, which MuJoCo replaces by a default with a warning."""
    messages: list[str] = []  # MuJoCo would write its warnings into a log file in the current folder
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(messages.append)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(before)
    if any("NaN" in warning for warning in messages):
        raise InputError("it holds a NaN: give finite numbers", "bad_mjcf")


def check_finite(model: mujoco.MjModel) -> None:
    """Check that all numbers of a model are finite: MuJoCo accepts NaN and infinity in most places."""
    found = []
    for place, holder in (("", model), ("option.", model.opt)):
        for name in (name for name in dir(holder) if not name.startswith("_")):
            value: Any = getattr(holder, name)
            if isinstance(value, float | np.ndarray) and np.asarray(value).dtype.kind == "f":
                wrong = np.ravel(value)[~np.isfinite(np.ravel(value))]
                found += [(bool(np.isnan(wrong[0])), f"{place}{name} holds {wrong[0]}")] if wrong.size else []
    if found:  # an infinity first: a NaN may be computed from it
        raise InputError(f"{min(found)[1]}: give finite numbers", "bad_mjcf")


def check_time_step(model: mujoco.MjModel) -> None:
    """Check that the time step suits the certificate."""
    step, allowed = float(model.opt.timestep), f"{MIN_STEP_S:g} to {MAX_STEP_S:g} s"
    if not MIN_STEP_S <= step <= MAX_STEP_S:
        raise InputError(f"the timestep is {step:g} s; drift is measured with {allowed}", "bad_mjcf")
