"""Inputs of the judge that run.json records: recorded answers and the prompt."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from schemas.config import Config
from schemas.identity import content_hash
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.stages.curate.prompt import PROMPT_SHA256


def record_answers(config: Config, _before: Mapping[str, Any]) -> dict[str, Any] | None:
    """Hash the names and bytes of the answers that are replayed; ConfigError if there are none."""
    if config.curate.judge != "replay":
        return None
    folder = Path(config.curate.replay_dir)
    files = sorted(path for path in folder.glob("*.json") if path.is_file())
    if not files:
        problem = "holds no answers" if folder.is_dir() else "is no folder"
        raise ConfigError(f"curate.replay_dir: {folder} {problem}; give the one with <scene_id>.json in it")
    digests = (f"{path.name} {content_hash(path.read_bytes())}".encode() for path in files)
    return {"sha256": content_hash(*digests), "files": len(files)}


def record_prompts(config: Config, _before: Mapping[str, Any]) -> dict[str, str] | None:
    """Record the hash of the judge's prompt if a model is asked."""
    return {"judge": PROMPT_SHA256} if config.curate.protocol else None
