"""A build that a wrong configuration stopped says how to go on with a right one, and that way works."""

from dataclasses import replace

import pytest

from schemas.config import Config
from tableverse_factory.core.errors import BuildError
from tests.helpers.builds import Silent, write_manifest
from tests.helpers.model_server import Scripted, chat, model_server
from workers.run import BuildRequest, run_build


def asking(url: str, model: str) -> Config:
    return Config.model_validate({"perceive": {"detector": "openai", "base_url": url, "model": model}})


def test_a_model_that_is_not_there_is_corrected_with_from(tmp_path):
    manifest = write_manifest(tmp_path / "images.parquet", ["one"])
    with model_server() as server:
        server.on_ask = lambda asked: chat('{"a": 1}') if asked["model"] == "right" else Scripted(status=404)
        wrong = BuildRequest(
            manifest,
            tmp_path / "out",
            asking(server.url, "wrong"),
            tmp_path / "cache",
            pipeline="tests.helpers.model_query_pipeline:PIPELINES",
        )
        with pytest.raises(BuildError, match=r"run the same command to go on; .* correct it and add --from perceive$"):
            run_build(wrong, Silent())
        right = replace(wrong, config=asking(server.url, "right"), from_stage="perceive")
        assert run_build(right, Silent()).tally.ended["export", "done"] == 1
