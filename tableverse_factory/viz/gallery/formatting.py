"""Formatting of figures and codes for pages; unknown values become a dash. Templates use them as filters."""

import math
import shlex
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from tableverse_factory.dataset.doubtful_scales import is_scale_doubtful

DASH = "–"

_EXPLANATIONS = {
    "unreadable_color": "the picture does not decode",
    "unreadable_depth": "the depth image does not decode",
    "missing_depth": "the capture has no depth image",
    "missing_camera": "the capture has no camera.json",
    "missing_mesh": "a mesh that the layout names is not there",
    "depth_not_16_bit": "the depth image is not a 16-bit greyscale PNG",
    "depth_size_differs": "depth and colour have different sizes: register the depth to the colour image",
    "content_changed": "the files are not those that the manifest recorded: make the manifest again, for another OUT",
    "bad_intrinsics": "the camera intrinsics are invalid",
    "bad_known_length": "the known length of the picture is not in the expected form",
    "known_length_unmeasured": "the known length cannot be measured in the depth",
    "scale_implausible": "the known length contradicts the depth model by a factor beyond 0.2 to 5",
    "scale_contradicts_sensor": "the known length contradicts the depth of the sensor",
    "bad_detections": "detections.json is not in the expected form",
    "bad_masks": "masks.png does not fit the picture",
    "bad_layout": "the layout file is not in the expected form",
    "bad_mesh": "a mesh does not decode to finite triangles",
    "depth_all_zero": "the depth image has no valid depth",
    "picture_too_large": "more pixels than the limit",
    "picture_too_narrow": "too narrow for depth models",
    "picture_too_small": "too few pixels to see anything",
    "unsupported_format": "pictures of this format are not read: give PNG, JPEG or WebP",
    "unsupported_pixels": "the picture is not 8-bit colour or grey",
    "animated_picture": "the picture has several frames",
    "transparent_picture": "the picture has transparent pixels",
    "no_table": "the net sees no table-top in the picture",
    "no_table_plane": "no table plane was found",
    "no_table_detected": "the detector found no table-top",
    "no_objects": "nothing stands on the table",
    "too_little_explained": "the objects explain too little of what stands on the table",
    "nothing_placed": "no object could be placed",
    "no_depth_model": "a picture without depth needs a depth model: set observe.depth",
    "no_recorded_depth": "there is no recorded depth beside the picture",
    "unusable_mesh": "a mesh cannot be simulated",
    "not_at_rest": "the objects did not come to rest",
    "simulation_unstable": "the simulation became unstable",
    "colliding": "two objects still overlap",
    "object_fell": "an object fell off the table",
    "detector_answer_invalid": "the detector's answer could not be read: another perceive.model may do better",
    "detector_answer_refused": "the model refused this picture",
    "judge_answer_missing": "there is no recorded answer of the judge",
    "judge_answer_invalid": "the judge's answer could not be read",
    "judge_answer_refused": "the model refused to judge this picture",
    "ModelError": "a model did not answer",
    "timeout": "a stage took longer than its deadline",
    "crash": "native code crashed",
    "out_of_memory": "a stage exceeded its memory limit",
    "exception": "an error in the code",
}


PERTURBATION_NAMES = {  # of `robotics.execution.perturbations`
    "friction_halved": "half friction",
    "friction_doubled": "double friction",
    "mass_minus_30": "−30 % mass",
    "mass_plus_30": "+30 % mass",
}


def format_millimetres(metres: float | None) -> str:
    """Format a length in mm with its significant digits."""
    if metres is None:
        return DASH
    value = 1000 * metres
    digits = 3 if abs(value) < 0.1 else 2 if abs(value) < 10 else 0
    text = f"{value:.{digits}f}"
    return f"{text.rstrip('0').rstrip('.') if digits else text} mm"


def format_degrees(radians: float | None) -> str:
    """Format an angle in degrees."""
    return DASH if radians is None else f"{57.29577951308232 * radians:.3f}°"


def format_mass(kilograms: float | None) -> str:
    """Format a mass in g or kg."""
    if kilograms is None:
        return DASH
    return f"{1000 * kilograms:.0f} g" if kilograms < 1 else f"{kilograms:.2f} kg"


def format_size(item: dict[str, Any]) -> str:
    """Format the three sides of the box of an object in mm."""
    sides = [item["size_x_m"], item["size_y_m"], item["size_z_m"]]
    return DASH if None in sides else " × ".join(f"{1000 * side:.0f}" for side in sides)


def format_confidence(value: float | None) -> str:
    """Format a confidence with two digits."""
    return DASH if value is None else f"{value:.2f}"


SCALE_NAMES = {  # of `schemas.observation.ScaleSource`
    "sensor": "by a depth sensor",
    "measured": "measured by a known length",
    "estimated": "estimated by a depth model",
    "given": "given by the layout",
}
CAMERA_NAMES = {  # of `schemas.observation.IntrinsicsSource`
    "capture": "from its file",
    "exif": "from EXIF",
    "sheet": "by the sheet of known size",
    "model": "by the depth model",
    "assumed": "assumed",
}


def format_scale(row: Mapping[str, Any]) -> str:
    """Format where the metres of a scene come from, and how sure they are."""
    sigma, deviation = row.get("scale_sigma"), row.get("scale_deviation")
    parts = [SCALE_NAMES.get(str(row.get("scale_source")), DASH)]
    if isinstance(sigma, float) and sigma > 0.0:
        parts.append(f"±{100 * sigma:.1f} %")
    if isinstance(deviation, float):
        side = "larger" if deviation > 0 else "smaller"
        doubt = ": check the known length" if is_scale_doubtful(deviation) else ""
        parts.append(f"{abs(deviation):.1f} standard deviations {side} than estimated{doubt}")
    return ", ".join(parts)


def format_camera(row: Mapping[str, Any]) -> str:
    """Format where the intrinsics of a scene's camera come from, and the angle of its view."""
    name, field = CAMERA_NAMES.get(str(row.get("intrinsics_source"))), row.get("field_of_view_deg")
    if name is None:
        return DASH
    return f"{name}, {field:.0f}°" if isinstance(field, float) and math.isfinite(field) else name


def format_code(text: str | None) -> str:
    """Format a reason code as words."""
    return DASH if text is None else text.replace("_", " ")


def explain_reason(text: str | None) -> str:
    """Explain a reason code; empty if it has no explanation."""
    return _EXPLANATIONS.get(text or "", "")


def explain_reasons(codes: Iterable[str]) -> list[str]:
    """List `code: explanation` for each code that has one, once each, in order."""
    return [f"{text}: {_EXPLANATIONS[text]}" for text in dict.fromkeys(codes) if text in _EXPLANATIONS]


def format_phase(text: str | None) -> str:
    """Format the name of a phase."""
    return DASH if text is None else text.replace("_", "-")


def format_grasp_stage(number: int | None) -> str:
    """Format which of the three grasp filters was used."""
    names = {None: DASH, 1: "from above", 2: "downward", 3: "the most confident of any direction"}
    return names.get(number, str(number))


def format_perturbations(names: list[str] | None) -> str:
    """Format the perturbations of friction and mass under which a trajectory succeeds too."""
    survived = [PERTURBATION_NAMES.get(name, format_code(name)) for name in names or ()]
    if set(names or ()) == set(PERTURBATION_NAMES):
        return "half and double friction, ±30 % mass"
    return ", ".join(survived) or "no change of friction or mass"


FILTERS: dict[str, Callable[..., str]] = {
    "mm": format_millimetres,
    "degrees": format_degrees,
    "mass": format_mass,
    "size": format_size,
    "share": format_confidence,
    "code": format_code,
    "scale": format_scale,
    "camera": format_camera,
    "changes": format_perturbations,
    "phase": format_phase,
    "grasp_stage": format_grasp_stage,
    "explained": explain_reason,
    "quoted": shlex.quote,
}
