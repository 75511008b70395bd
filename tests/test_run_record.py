"""run.json: whatever decides bytes is in it, so that nothing is resumed that would come out differently."""

import pytest

from schemas.config import Config, CurateConfig
from tableverse_factory.core.errors import ConfigError
from tableverse_factory.pipeline import STAGES
from tableverse_factory.run_record import collect_external_inputs, diff_run_records, make_run_record
from workers.plan.rerun import find_first_affected_stage


def replaying(folder) -> Config:
    return Config(curate=CurateConfig(judge="replay", replay_dir=str(folder)))


def record(config: Config) -> dict:
    return make_run_record(config, collect_external_inputs(config), "0" * 64, 3, {})


@pytest.mark.parametrize("change", ["content", "added", "removed", "renamed"])
def test_another_set_of_answers_is_another_run(tmp_path, change):
    (tmp_path / "a.json").write_text("{}")
    (tmp_path / "b.json").write_text("[]")
    before = record(replaying(tmp_path))
    assert record(replaying(tmp_path)) == before
    (tmp_path / "notes.txt").write_text("not an answer")
    assert record(replaying(tmp_path)) == before
    if change == "content":
        (tmp_path / "a.json").write_text("[]")
    elif change == "added":
        (tmp_path / "c.json").write_text("{}")
    elif change == "removed":
        (tmp_path / "b.json").unlink()
    else:
        (tmp_path / "b.json").rename(tmp_path / "d.json")
    after = record(replaying(tmp_path))
    assert after["fingerprint"] != before["fingerprint"]
    assert "answers.sha256" in diff_run_records(before, after)


def test_a_folder_of_answers_that_is_not_there_is_said_so(tmp_path):
    with pytest.raises(ConfigError, match=r"curate.replay_dir: .*nowhere is no folder"):
        record(replaying(tmp_path / "nowhere"))


def test_a_prompt_is_part_of_a_run_that_asks_a_model():
    asking = CurateConfig(judge="openai", base_url="http://localhost:8000/v1", model="m")
    assert len(record(Config(curate=asking))["prompts"]["judge"]) == 64
    assert not {"prompts", "answers", "detector"} & set(record(Config()))


def test_the_detectors_prompt_is_part_of_a_run_and_of_the_stage_that_asks():
    asking = {"detector": "openai", "base_url": "http://localhost:8000/v1", "model": "m"}
    runs = [record(Config.model_validate({"perceive": {**asking, "box_order": o}})) for o in ("auto", "xyxy", "yxyx")]
    prompts = [run["detector"]["prompt_sha256"] for run in runs]
    assert prompts[0] == prompts[1] != prompts[2]
    changed = {**runs[0], "detector": {"prompt_sha256": "0" * 64}}
    assert [*diff_run_records(runs[0], changed)] == ["detector.prompt_sha256"]
    assert find_first_affected_stage(STAGES, ["detector.prompt_sha256"]) == [stage.name for stage in STAGES].index(
        "perceive"
    )


def test_the_code_is_part_of_a_run():
    now = record(Config())
    before = {**now, "versions": {**now["versions"], "code": "0123456789ab"}}
    assert len(now["versions"]["code"]) == 12
    assert diff_run_records(before, now) == {"versions.code": ("0123456789ab", now["versions"]["code"])}


@pytest.mark.parametrize(
    ("section", "keys"),
    [
        ("perceive", {"segmenter": "sam2", "detector": "replay", "segmenter_weights": ""}),
        ("observe", {"depth": "moge_2", "depth_weights": ""}),
    ],
    ids=["segmenter", "depth"],
)
@pytest.mark.parametrize("there", ["nothing", "an empty folder"])
def test_weights_on_the_disk_must_be_there_before_a_build_begins(tmp_path, section, keys, there):
    if there == "an empty folder":
        (tmp_path / "weights").mkdir()
    (key,) = (name for name, value in keys.items() if value == "")
    config = Config.model_validate({section: {**keys, key: str(tmp_path / "weights")}})
    with pytest.raises(ConfigError, match=rf"^{section}\.{key}: .*weights' (is not there|holds no weights)"):
        collect_external_inputs(config)
