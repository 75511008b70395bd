"""Part E by rules: the quality score from four weighted criteria."""

from schemas.curation import CriterionScore, PerCriterion
from tableverse_factory.stages.curate.judge_input import JudgedObject, JudgeInput
from tableverse_factory.stages.curate.lexicon import find_head_noun, is_generic

WEIGHTS = {"category_diversity": 0.45, "geometric_plausibility": 0.15, "graspability": 0.15, "layout_clarity": 0.25}
FEW_OBJECTS = 5
UNUSABLE_CAP = 4
_MANY_OBJECTS = 10
_MANY_CATEGORIES = 8
_BAD_FIT_M = 0.012
_SHEET_M = 0.0015
_STRAYED_M = 0.02
_DEEP_M = 0.02
_OFF_TABLE_M = -0.005


def score_criteria(
    case: JudgeInput, names: tuple[str, ...], graspable: tuple[int, ...], partitioned: bool
) -> PerCriterion:
    """Score the four criteria, 1 to 10 each; `names` are those of part F."""
    bad = tuple(index for index, item in enumerate(case.items) if has_bad_geometry(item))
    count = max(len(case.items), 1)
    ungraspable = tuple(index for index in range(len(case.items)) if index not in graspable)
    share = _to_points(len(graspable) / count)
    return PerCriterion(
        category_diversity=CriterionScore(score=_score_diversity(names)),
        geometric_plausibility=CriterionScore(score=_to_points(1 - 1.5 * len(bad) / count), bad_geometry_ids=bad),
        graspability=CriterionScore(score=share, graspable_ids=graspable, ungraspable_ids=ungraspable),
        layout_clarity=CriterionScore(score=_to_points(_measure_clarity(case, partitioned))),
    )


def compute_final_score(criteria: PerCriterion, n_objects: int, usable: bool) -> int:
    """Compute the weighted mean: below five objects at most two more than objects; at most 4 if unusable."""
    few = n_objects + 2 if n_objects < FEW_OBJECTS else 10
    return min(max(int(weigh_criteria(criteria) + 0.5), 1), few, 10 if usable else UNUSABLE_CAP)


def weigh_criteria(criteria: PerCriterion) -> float:
    """Compute the weighted mean of the criteria, 1 to 10."""
    return sum(weight * float(getattr(criteria, name).score) for name, weight in WEIGHTS.items())


def has_bad_geometry(item: JudgedObject) -> bool:
    """Whether the mesh is far from the observed points, has no volume, or is a thin sheet."""
    return item.fit_residual_m > _BAD_FIT_M or item.volume_m3 <= 0.0 or float(item.size.min()) < _SHEET_M


def _score_diversity(names: tuple[str, ...]) -> int:
    """Score the numbers of objects and categories; below five objects no more points than objects."""
    categories = {name if is_generic(name) else find_head_noun(name) for name in names}
    points = _to_points(0.6 * min(len(names) / _MANY_OBJECTS, 1.0) + 0.4 * min(len(categories) / _MANY_CATEGORIES, 1.0))
    return min(points, max(len(names), 1)) if len(names) < FEW_OBJECTS else points


def _measure_clarity(case: JudgeInput, partitioned: bool) -> float:
    """Measure clarity: 1 for a layout that stands as seen, less for what clipped, strayed, sank or fell apart."""
    count = max(len(case.items), 1)
    strayed = sum(item.displacement_m > _STRAYED_M for item in case.items) / count
    sunk = sum(float(item.body.low[2]) < _OFF_TABLE_M for item in case.items) / count
    clipping = min(case.penetration_before_m / _DEEP_M, 1.0)
    return 1.0 - 0.3 * clipping - 1.0 * strayed - 0.6 * sunk - 0.4 * partitioned


def _to_points(share: float) -> int:
    return int(1.5 + 9 * min(max(share, 0.0), 1.0))
