"""Parts B, C and D by rules: labels that cannot be right, confidence in the rest, mass and hinge."""

from schemas.curation import PhysicalProperties, SevereLabelError
from tableverse_factory.physics.bodies.materials import estimate_mass_kg
from tableverse_factory.stages.curate.appearance import name_shape
from tableverse_factory.stages.curate.judge_input import JudgedObject, JudgeInput
from tableverse_factory.stages.curate.lexicon import find_hinge_category, is_generic, look_up_size_range

SEVERE_FACTOR = 2.5  # sizes further outside the lexicon's range are label errors: the paper asks for a high bar
GENERIC_CONFIDENCE = 0.3


def find_label_errors(case: JudgeInput) -> SevereLabelError:
    """Find labels of objects impossibly small or large for them, each corrected to what the shape suggests."""
    wrong = {i: item for i, item in enumerate(case.items) if _compute_size_error(item) > SEVERE_FACTOR}
    return SevereLabelError(
        has_severe_label_error=bool(wrong),
        evidence_ids=tuple(wrong),
        correct_labels={str(i): name_shape(item.body, item.size, item.volume_m3) for i, item in wrong.items()},
    )


def estimate_label_confidence(item: JudgedObject) -> float:
    """Return the detector's confidence, lowered where the label is generic or the size is odd for it."""
    confidence = min(max(item.confidence, 0.0), 1.0)
    if is_generic(item.label):
        return round(min(confidence, GENERIC_CONFIDENCE), 3)
    return round(confidence / max(_compute_size_error(item), 1.0), 3)


def _compute_size_error(item: JudgedObject) -> float:
    """Factor by which the object is too small or too large for its label; at most 1 where the size is possible."""
    if (known := look_up_size_range(item.label)) is None:
        return 1.0
    longest = max(float(item.size.max()), 1e-6)
    return max(known[0] / longest, longest / known[1])


def estimate_physical_properties(item: JudgedObject) -> PhysicalProperties:
    """Estimate mass from volume, shell and material; look up the hinge by label.

    An unnamed vessel counts as a cup or bowl: its volume is that of its walls, and solid.
    """
    hinge, name = find_hinge_category(item.label), item.label
    if is_generic(name) and item.body.cavity is not None:
        name = name_shape(item.body, item.size, item.volume_m3)
    mass = estimate_mass_kg(name, item.volume_m3, item.size)
    return PhysicalProperties(mass_kg=round(mass, 5), has_hinge=hinge is not None, hinge_category=hinge)
