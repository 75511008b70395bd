"""Parts B and C: labels that cannot be right, and how sure we are of the rest."""

from schemas.curation import SevereLabelError
from tableverse_factory.stages.curate.appearance import name_shape
from tableverse_factory.stages.curate.judge_input import JudgedObject, JudgeInput
from tableverse_factory.stages.curate.lexicon import is_generic, look_up_size_range

SEVERE_FACTOR = 2.5
"""Beyond the lexicon's sizes by this much a label is called wrong: a high bar, as the paper asks."""

GENERIC_CONFIDENCE = 0.3


def find_label_errors(case: JudgeInput) -> SevereLabelError:
    """Labels whose things are impossibly small or large; corrected to what the shape suggests."""
    wrong = tuple(index for index, item in enumerate(case.items) if _compute_size_error(item) > SEVERE_FACTOR)
    return SevereLabelError(
        has_severe_label_error=bool(wrong),
        evidence_ids=wrong,
        correct_labels={str(i): _name_by_shape(case.items[i]) for i in wrong},
    )


def estimate_label_confidence(item: JudgedObject) -> float:
    """The detector's confidence, lower where the label names nothing or the size is odd for it."""
    confidence = min(max(item.confidence, 0.0), 1.0)
    if is_generic(item.label):
        return round(min(confidence, GENERIC_CONFIDENCE), 3)
    return round(confidence / max(_compute_size_error(item), 1.0), 3)


def _compute_size_error(item: JudgedObject) -> float:
    """How many times too small or too large the thing is for its label; at most 1 where it is possible."""
    known = look_up_size_range(item.label)
    if known is None:
        return 1.0
    long = max(float(item.size.max()), 1e-6)
    return max(known[0] / long, long / known[1])


def _name_by_shape(item: JudgedObject) -> str:
    return name_shape(item.body, item.size, item.volume_m3)
