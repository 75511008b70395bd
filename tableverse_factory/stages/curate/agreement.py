"""How far a judge and the rules agree: neither is the truth, and where they part a person should look."""

from statistics import median

from schemas.config import CurateConfig
from schemas.curation import Agreement, Assessment
from tableverse_factory.models.services import Services
from tableverse_factory.stages.curate.checks import assess_answer
from tableverse_factory.stages.curate.judge_input import JudgeInput
from tableverse_factory.stages.curate.lexicon import find_head_noun, may_share_noun
from tableverse_factory.stages.curate.rules import RulesJudge


def compare_with_rules(verdict: Assessment, case: JudgeInput, config: CurateConfig, services: Services) -> Agreement:
    """Compares the verdict on a judge's answer with what the rules make of the same case."""
    rules = assess_answer(RulesJudge(config, services).judge(case), case, config)
    pairs = list(zip(verdict.objects, rules.objects, strict=True))
    same = [
        may_share_noun(find_head_noun(mine.relabel_name), find_head_noun(theirs.relabel_name)) for mine, theirs in pairs
    ]
    ratios = [mine.mass_kg / theirs.mass_kg for mine, theirs in pairs if mine.answered_mass_kg is not None]
    tasks, ruled_tasks = _list_accepted(verdict), _list_accepted(rules)
    return Agreement(
        rules_usable=rules.usable,
        rules_score=rules.quality_score,
        names_share=sum(same) / max(len(same), 1),
        mass_ratio=median(ratios) if ratios else 1.0,
        rules_tasks=len(ruled_tasks),
        shared_tasks=len(tasks & ruled_tasks),
    )


def _list_accepted(verdict: Assessment) -> set[tuple[str, str, str]]:
    return {(task.x_id, task.relation, task.y_id) for task in verdict.tasks if task.accepted}
