"""Table of judges by the name in `curate.judge`."""

from collections.abc import Callable

from schemas.config import CurateConfig
from tableverse_factory.models.services import Services
from tableverse_factory.stages.curate.interfaces import Judge
from tableverse_factory.stages.curate.model import ModelJudge
from tableverse_factory.stages.curate.replay import ReplayJudge
from tableverse_factory.stages.curate.rules import RulesJudge

JUDGES: dict[str, Callable[[CurateConfig, Services], Judge]] = {
    "rules": RulesJudge,
    "openai": ModelJudge,
    "gemini": ModelJudge,
    "replay": ReplayJudge,
}
