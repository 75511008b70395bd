"""Summary of a dataset's judgements, and of how far the rules agree."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from statistics import mean, median

import pyarrow as pa
import pyarrow.compute as pc

from tableverse_factory.dataset.columns import count_groups

_COMPARED = (
    *("usable", "quality_score", "rules_usable", "rules_score", "rules_names_share", "rules_mass_ratio"),
    *("rules_tasks", "rules_shared_tasks"),
)
JUDGEMENT_COLUMNS = ("status", "judge", "judge_model", "judge_remarks", *_COMPARED)


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
    """Judgements by judge, and remarks on them."""

    judges: Mapping[str, int]  # scenes by judge, `openai: model` where a model was asked
    judged: int  # scenes with a verdict
    usable: int  # those of them that are
    remarks: Mapping[str, int]  # on what the checks of the verdicts corrected, by code
    agreement: RulesAgreement | None  # None if only the rules judged


def summarize_judgements(scenes: pa.Table) -> JudgeSummary:
    """Summarize the judgements of rows of scenes/ with `JUDGEMENT_COLUMNS`."""
    done = scenes.select(list(JUDGEMENT_COLUMNS)).filter(pc.equal(scenes["status"], "done"))
    judges, remarks = Counter[str](), Counter[str]()
    for (judge, model), count in count_groups(done, ("judge", "judge_model")).items():
        judges[": ".join(filter(None, (judge or "none", model)))] += count
    for remark in pc.value_counts(pc.list_flatten(done["judge_remarks"])).to_pylist():
        remarks[remark["values"].partition(":")[0]] += remark["counts"]
    compared = done.select(list(_COMPARED)).filter(pc.is_valid(done["rules_score"]))
    return JudgeSummary(
        judges=dict(sorted(judges.items())),
        judged=pc.count(done["usable"]).as_py(),
        usable=pc.sum(done["usable"]).as_py() or 0,
        remarks=dict(sorted(remarks.items(), key=lambda item: (-item[1], item[0]))),
        agreement=_agreement(compared) if compared.num_rows else None,
    )


def _agreement(rows: pa.Table) -> RulesAgreement:
    usable, ruled = rows["usable"], rows["rules_usable"]
    n_same = pc.sum(pc.equal(usable, ruled)).as_py() or 0
    n_same += pc.sum(pc.and_(pc.is_null(usable), pc.is_null(ruled))).as_py()
    shared, tasks = (pc.sum(rows[name]).as_py() or 0 for name in ("rules_shared_tasks", "rules_tasks"))
    return RulesAgreement(
        scenes=rows.num_rows,
        usable_share=n_same / rows.num_rows,
        score_difference=float(median(pc.subtract(rows["quality_score"], rows["rules_score"]).to_pylist())),
        names_share=mean(rows["rules_names_share"].to_pylist()),
        mass_ratio=median(rows["rules_mass_ratio"].to_pylist()),
        tasks_share=shared / max(tasks, 1),
    )
