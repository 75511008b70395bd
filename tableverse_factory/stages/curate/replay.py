"""The judge `replay`: recorded answers, one file per scene."""

from pathlib import Path

from schemas.config import CurateConfig
from tableverse_factory.core.errors import AnswerInvalidError
from tableverse_factory.models.remote.json_text import MAX_ANSWER_CHARS
from tableverse_factory.models.services import Services
from tableverse_factory.stages.curate.interfaces import Judgement
from tableverse_factory.stages.curate.judge_input import JudgeInput
from tableverse_factory.stages.curate.parse_answer import parse_judgement

_MAX_BYTES = 4 * MAX_ANSWER_CHARS  # bound on the bytes read: a character of UTF-8 takes at most four


class ReplayJudge:
    """Reads `<replay_dir>/<scene_id>.json`."""

    def __init__(self, config: CurateConfig, services: Services) -> None:  # noqa: ARG002
        self._folder = Path(config.replay_dir)

    def judge(self, case: JudgeInput) -> Judgement:
        """Read the recorded answer; AnswerInvalidError if there is none or it does not follow the paper's schema."""
        path = self._folder / f"{case.scene_id}.json"
        try:
            with path.open("rb") as file:
                text = file.read(_MAX_BYTES + 1).decode("utf-8", errors="replace")
        except OSError as error:
            raise AnswerInvalidError(f"no recorded answer: {error.strerror}", "answer_missing") from error
        return Judgement(parse_judgement(text), text)
