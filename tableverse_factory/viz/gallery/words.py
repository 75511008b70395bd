"""Figures as people read them. Templates use these filters; what is not known is a dash."""

import shlex
from collections.abc import Callable, Iterable
from typing import Any

DASH = "–"

_WHY = {
    "unreadable_color": "the picture does not decode",
    "unreadable_depth": "the depth image does not decode",
    "missing_depth": "the capture has no depth image",
    "missing_camera": "the capture has no camera.json",
    "missing_mesh": "a mesh that the layout names is not there",
    "bad_intrinsics": "the camera's numbers make no sense",
    "bad_detections": "detections.json is not in the expected form",
    "bad_masks": "masks.png does not fit the picture",
    "bad_layout": "the layout file is not in the expected form",
    "bad_mesh": "a mesh does not decode to finite triangles",
    "depth_all_zero": "the depth image holds no reading",
    "picture_too_large": "more pixels than are decoded",
    "picture_too_narrow": "a strip, which no depth model knows",
    "no_table_plane": "no plane that could be a table was found",
    "no_table_detected": "the detector sees no table-top",
    "no_objects": "nothing stands on the table",
    "nothing_placed": "no object could be placed",
    "no_depth_model": "a picture without depth needs a depth model: set observe.depth",
    "no_focal_length": "the picture does not tell its focal length: set observe.focal_px, or a model that tells it",
    "no_recorded_depth": "no depth lies beside the picture",
    "unusable_mesh": "a mesh cannot be simulated",
    "not_at_rest": "the objects would not come to rest",
    "simulation_unstable": "the simulation broke down",
    "colliding": "two objects still overlap",
    "object_fell": "an object fell off the table",
    "detector_answer_invalid": "the detector's answer could not be read: another perceive.model may do better",
    "detector_answer_refused": "the model would not look at this picture",
    "judge_answer_missing": "there is no recorded answer of the judge",
    "judge_answer_invalid": "the judge's answer could not be read",
    "judge_answer_refused": "the model would not judge this picture",
    "ModelError": "a model did not answer",
    "timeout": "a stage took longer than its deadline",
    "crash": "native code crashed",
    "out_of_memory": "a stage used more memory than it may",
    "exception": "an error in the code",
}


CHANGES = {
    "friction_halved": "half friction",
    "friction_doubled": "double friction",
    "mass_minus_30": "−30 % mass",
    "mass_plus_30": "+30 % mass",
}
"""Those of `proof.changes`."""


def millimetres(metres: float | None) -> str:
    """A length in mm, with as many digits as mean something."""
    if metres is None:
        return DASH
    value = 1000 * metres
    digits = 3 if abs(value) < 0.1 else 2 if abs(value) < 10 else 0
    text = f"{value:.{digits}f}"
    return f"{text.rstrip('0').rstrip('.') if digits else text} mm"


def degrees(radians: float | None) -> str:
    """An angle in degrees."""
    return DASH if radians is None else f"{57.29577951308232 * radians:.3f}°"


def mass(kilograms: float | None) -> str:
    """A mass in g or kg."""
    if kilograms is None:
        return DASH
    return f"{1000 * kilograms:.0f} g" if kilograms < 1 else f"{kilograms:.2f} kg"


def size(item: dict[str, Any]) -> str:
    """The three sides of an object's box in mm."""
    sides = [item["size_x_m"], item["size_y_m"], item["size_z_m"]]
    return DASH if None in sides else " × ".join(f"{1000 * side:.0f}" for side in sides)


def share(value: float | None) -> str:
    """0.71 for a confidence."""
    return DASH if value is None else f"{value:.2f}"


def code(text: str | None) -> str:
    """A reason's code as words."""
    return DASH if text is None else text.replace("_", " ")


def explained(text: str | None) -> str:
    """A sentence for a reason's code; empty where there is none."""
    return _WHY.get(text or "", "")


def explained_all(codes: Iterable[str]) -> list[str]:
    """`code: sentence` for each code that has one, each once, in their order."""
    return [f"{text}: {_WHY[text]}" for text in dict.fromkeys(codes) if text in _WHY]


def phase(text: str | None) -> str:
    """The name of a phase as words."""
    return DASH if text is None else text.replace("_", "-")


def grasp_stage(number: int | None) -> str:
    """Which of the three filters of grasps was used."""
    names = {None: DASH, 1: "from above", 2: "downward", 3: "the most confident of any direction"}
    return names.get(number, str(number))


def changes(names: list[str] | None) -> str:
    """Under which changes of friction and mass a trajectory succeeds too."""
    survived = [CHANGES.get(name, code(name)) for name in names or ()]
    if set(names or ()) == set(CHANGES):
        return "half and double friction, ±30 % mass"
    return ", ".join(survived) or "no change of friction or mass"


FILTERS: dict[str, Callable[..., str]] = {
    "mm": millimetres,
    "degrees": degrees,
    "mass": mass,
    "size": size,
    "share": share,
    "code": code,
    "changes": changes,
    "phase": phase,
    "grasp_stage": grasp_stage,
    "explained": explained,
    "quoted": shlex.quote,
}
