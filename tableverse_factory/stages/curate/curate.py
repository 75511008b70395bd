"""The stage `curate`: a judge's seven outputs, checked against the scene (paper section 3.3, appendix B)."""

from statistics import median

import numpy as np

from schemas.config import Config
from schemas.curation import Agreement, Assessment
from schemas.outcome import Done, Dropped, Outcome
from schemas.scene import CuratedScene, SettledScene
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.services import Services
from tableverse_factory.stages.curate.checks import assess_answer
from tableverse_factory.stages.curate.judge_input import build_judge_input
from tableverse_factory.stages.curate.lexicon import find_head_noun, may_share_noun
from tableverse_factory.stages.curate.registry import JUDGES
from tableverse_factory.stages.curate.rules import RulesJudge


def curate(
    scene: SettledScene,
    config: Config,
    rng: np.random.Generator,  # noqa: ARG001
    services: Services,
) -> Outcome[CuratedScene]:
    """Ask the configured judge and check its answer; low quality is recorded and never drops a scene.

    Drops: `judge_answer_missing` (nothing was recorded), `judge_answer_invalid` (no usable answer, also after a round
    of repair), `judge_answer_refused` (the model refuses to judge this picture).
    """
    case = build_judge_input(scene, config.curate)
    judge = config.curate.judge
    try:
        judgement = JUDGES[judge](config.curate, services).judge(case)
    except AnswerInvalidError as error:
        return Dropped(f"judge_{error.reason}", str(error))
    verdict = assess_answer(judgement, case, config.curate)
    if judge != "rules":
        rules = assess_answer(RulesJudge(config.curate, services).judge(case), case, config.curate)
        verdict = verdict.model_copy(update={"agreement": compare_verdicts(verdict, rules)})
    return Done(CuratedScene(scene.scene_id, scene, judge, verdict, case.twin.coverage))


def compare_verdicts(verdict: Assessment, rules: Assessment) -> Agreement:
    """Measure how far a judge and the rules agree; neither is the truth, and disagreement asks for a person's eye."""
    pairs = list(zip(verdict.objects, rules.objects, strict=True))
    same = [may_share_noun(find_head_noun(a.relabel_name), find_head_noun(b.relabel_name)) for a, b in pairs]
    ratios = [a.mass_kg / b.mass_kg for a, b in pairs if a.answered_mass_kg is not None]
    tasks, rules_tasks = ({(t.x_id, t.relation, t.y_id) for t in v.tasks if t.accepted} for v in (verdict, rules))
    return Agreement(
        rules_usable=rules.usable,
        rules_score=rules.quality_score,
        names_share=sum(same) / max(len(same), 1),
        mass_ratio=median(ratios) if ratios else 1.0,
        rules_tasks=len(rules_tasks),
        shared_tasks=len(tasks & rules_tasks),
    )
