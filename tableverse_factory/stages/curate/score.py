"""Part E by rules: the quality score from four weighted criteria."""

from schemas.curation import CriterionScore, PerCriterion
from tableverse_factory.stages.curate.judge_input import JudgedObject, JudgeInput
from tableverse_factory.stages.curate.lexicon import find_head_noun, is_generic

# Weights of the criteria, and the score of an unusable scene at most: those of the paper (appendix, part E and A). It
# also asks for a penalty below five objects, but does not say which
WEIGHTS = {"category_diversity": 0.45, "geometric_plausibility": 0.15, "graspability": 0.15, "layout_clarity": 0.25}
UNUSABLE_CAP = 4
FEW_OBJECTS = 5
_FEW_BONUS = 2  # points that a scene of few objects may have beyond their number

# Numbers of objects and of categories from which more earn nothing, and their weights
_MANY_OBJECTS, _MANY_CATEGORIES = 10, 8
_OBJECTS_WEIGHT, _CATEGORIES_WEIGHT = 0.6, 0.4

# Geometry that is bad, and its cost per share of the objects
_BAD_FIT_M = 0.012  # median distance of a mesh from the observed points
_SHEET_M = 0.0015  # shortest side of a mesh
_BAD_GEOMETRY_COST = 1.5

# A layout that is unclear: deepest penetration of the placed pieces that costs all that penetration can, and per share
# of the objects those whose centre has moved from where it was placed, and whose lowest point is below the table
_DEEP_M, _DEEP_COST = 0.02, 0.3
_STRAYED_M, _STRAYED_COST = 0.02, 1.0
_OFF_TABLE_M, _OFF_TABLE_COST = -0.005, 0.6
_PARTITIONED_COST = 0.4


def score_criteria(
    case: JudgeInput, names: tuple[str, ...], graspable: tuple[int, ...], partitioned: bool
) -> PerCriterion:
    """Score the four criteria, 1 to 10 each; `names` are those of part F."""
    bad = tuple(index for index, item in enumerate(case.items) if has_bad_geometry(item))
    count = max(len(case.items), 1)
    ungraspable = tuple(index for index in range(len(case.items)) if index not in graspable)
    share = _to_points(len(graspable) / count)
    sound = _to_points(1 - _BAD_GEOMETRY_COST * len(bad) / count)
    return PerCriterion(
        category_diversity=CriterionScore(score=_score_diversity(names)),
        geometric_plausibility=CriterionScore(score=sound, bad_geometry_ids=bad),
        graspability=CriterionScore(score=share, graspable_ids=graspable, ungraspable_ids=ungraspable),
        layout_clarity=CriterionScore(score=_to_points(_measure_clarity(case, partitioned))),
    )


def compute_final_score(criteria: PerCriterion, n_objects: int, usable: bool) -> int:
    """Compute the weighted mean: below five objects at most two more than objects; at most 4 if unusable."""
    few = n_objects + _FEW_BONUS if n_objects < FEW_OBJECTS else 10
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
    objects, kinds = min(len(names) / _MANY_OBJECTS, 1.0), min(len(categories) / _MANY_CATEGORIES, 1.0)
    points = _to_points(_OBJECTS_WEIGHT * objects + _CATEGORIES_WEIGHT * kinds)
    return min(points, max(len(names), 1)) if len(names) < FEW_OBJECTS else points


def _measure_clarity(case: JudgeInput, partitioned: bool) -> float:
    """Measure clarity: 1 for a layout that stands as seen, less for what clipped, strayed, sank or fell apart."""
    count = max(len(case.items), 1)
    strayed = sum(item.displacement_m > _STRAYED_M for item in case.items) / count
    sunk = sum(float(item.body.low[2]) < _OFF_TABLE_M for item in case.items) / count
    clipping = min(case.penetration_before_m / _DEEP_M, 1.0)
    return (
        1.0 - _DEEP_COST * clipping - _STRAYED_COST * strayed - _OFF_TABLE_COST * sunk - _PARTITIONED_COST * partitioned
    )


def _to_points(share: float) -> int:
    return int(1.5 + 9 * min(max(share, 0.0), 1.0))
