"""Summary of a dataset's judgements, and of how far the rules agree."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from statistics import mean, median
from typing import Any

from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.dataset.committed_rows import read_rows

_COLUMNS = (
    *("status", "judge", "judge_model", "judge_remarks", "usable", "quality_score", "rules_usable", "rules_score"),
    *("rules_names_share", "rules_mass_ratio", "rules_tasks", "rules_shared_tasks"),
)


@dataclass(frozen=True, slots=True)
class RulesAgreement:
    """Agreement of judge and rules, over the scenes that another judge than the rules has judged."""

    scenes: int
    usable_share: float  # scenes with the same gate
    score_difference: float  # median of judge minus rules
    names_share: float  # objects with the same noun, mean over scenes
    mass_ratio: float  # judge's masses over the rules', median over scenes of their medians
    tasks_share: float  # tasks of the rules that the judge has too


@dataclass(frozen=True, slots=True)
class JudgeSummary:
    """Judgements by judge, and remarks on their answers."""

    judges: Mapping[str, int]  # scenes by judge, `openai: model` where a model was asked
    remarks: Mapping[str, int]  # on what was not taken as answered, by code
    agreement: RulesAgreement | None  # None if only the rules judged


def summarize_judgements(out: StoragePath, shards: Sequence[int]) -> JudgeSummary:
    """Summarize the judgements of the scenes of these committed shards."""
    rows = [row for row in read_rows(out, "scenes", shards, _COLUMNS) if row["status"] == "done"]
    judges = Counter(": ".join(filter(None, (row["judge"] or "none", row["judge_model"]))) for row in rows)
    remarks = Counter(remark.partition(":")[0] for row in rows for remark in row["judge_remarks"] or ())
    compared = [row for row in rows if row["rules_score"] is not None]
    return JudgeSummary(
        judges=dict(sorted(judges.items())),
        remarks=dict(sorted(remarks.items(), key=lambda item: (-item[1], item[0]))),
        agreement=_agreement(compared) if compared else None,
    )


def _agreement(rows: Sequence[Mapping[str, Any]]) -> RulesAgreement:
    return RulesAgreement(
        scenes=len(rows),
        usable_share=mean(row["usable"] == row["rules_usable"] for row in rows),
        score_difference=float(median(row["quality_score"] - row["rules_score"] for row in rows)),
        names_share=mean(row["rules_names_share"] for row in rows),
        mass_ratio=median(row["rules_mass_ratio"] for row in rows),
        tasks_share=sum(row["rules_shared_tasks"] for row in rows) / max(sum(row["rules_tasks"] for row in rows), 1),
    )
