"""`--from` that is stopped gets on with the same command, wherever it was killed; two configurations never mix."""

import json
import shutil
from collections import Counter
from dataclasses import replace
from pathlib import Path

import pytest

from schemas.config import Config, CurateConfig, RunConfig, SettleConfig
from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset.journals import WORK
from tests.helpers.builds import QUICK, Silent, build, digests, request, scenes, write_manifest
from workers.plan import invalidate, start
from workers.plan.rerun import MARKER
from workers.progress.build_state import read_build_state
from workers.run import BuildRequest, run_build
from workers.state import commit

NAMES = ["fine", "empty", "fine", "sad", "fine", "fine"]


class Killed(BaseException):
    """As far as what lies on the disk is concerned, a kill."""


def die(*_: object) -> None:
    raise Killed


def asked(folder: Path, out: Path, max_time_s: float, from_stage: str | None = "settle") -> BuildRequest:
    config = Config(run=RunConfig(**QUICK), settle=SettleConfig(max_time_s=max_time_s))
    return replace(request(folder / "m.parquet", out), config=config, from_stage=from_stage)


@pytest.fixture(scope="module")
def half(tmp_path_factory):
    """A folder with a build begun again with 7 s, stopped before its last scene; what 7 s and 9 s give from scratch."""
    folder = tmp_path_factory.mktemp("half")
    build(write_manifest(folder / "m.parquet", NAMES), folder / "out")
    run_build(replace(asked(folder, folder / "out", 7.0), limit=3), Silent())
    for seconds in (7.0, 9.0):
        run_build(asked(folder, folder / f"whole_{seconds:g}", seconds, None), Silent())
    return folder


@pytest.fixture
def out(half, tmp_path):
    shutil.copytree(half / "out", tmp_path / "out")
    return tmp_path / "out"


def test_the_same_command_goes_on_and_computes_nothing_twice(half, out, marks):
    assert (out / WORK / MARKER).exists()
    assert run_build(asked(half, out, 7.0), Silent()).tally.before == len(NAMES) - 1
    counts = marks()
    assert counts == {"scene_005.settle": 1, "scene_005.pack": 1}
    assert digests(out) == digests(half / "whole_7")
    assert not (out / WORK / MARKER).exists()
    run_build(asked(half, out, 7.0), Silent())
    assert set(marks()) > set(counts), "once it is complete, the same command is a new wish"


def killed_before(step: str, order: BuildRequest, monkeypatch) -> None:
    with monkeypatch.context() as patched:
        if step == "second journal":
            journals = [invalidate.open_journal, die]
            patched.setattr(invalidate, "open_journal", lambda place: journals.pop(0)(place))
        else:
            patched.setattr(start, step, die)
        with pytest.raises(Killed):
            run_build(order, Silent())


def test_without_from_it_goes_on_too_and_another_stage_begins_anew(half, out, monkeypatch):
    with pytest.raises(BuildError, match=r"max_time_s was 7\.0 and is now 9\.0.* --from settle"):
        run_build(asked(half, out, 9.0, None), Silent())
    killed_before("invalidate_scenes", asked(half, out, 7.0, "export"), monkeypatch)
    assert not (out / WORK / MARKER).exists()
    run_build(replace(asked(half, out, 7.0, "export"), limit=1), Silent())
    assert read_build_state(out).remaining == 3, "those that are sad or empty keep their end, one is done, three wait"
    run_build(asked(half, out, 7.0, None), Silent())
    assert digests(out) == digests(half / "whole_7")


def test_a_new_out_is_begun_from_the_start_and_its_stop_costs_nothing(half, tmp_path, marks):
    with pytest.raises(BuildError, match="no such stage for a capture"):
        run_build(asked(half, tmp_path / "new", 7.0, "polish"), Silent())
    assert not (tmp_path / "new" / "run.json").exists()
    for limit in (2, None):
        run_build(replace(asked(half, tmp_path / "new", 7.0), limit=limit), Silent())
    assert set(marks().values()) == {1}
    assert digests(tmp_path / "new") == digests(half / "whole_7")


OTHER_STEPS = (
    "second journal",
    "write_run",
    "clear_rerun_marker",
    "publish_ready",
    "invalidate_scenes",
    "delete_checkpoints",
)
STEPS = ["write_rerun_marker", *(pytest.param(step, marks=pytest.mark.slow) for step in OTHER_STEPS)]


@pytest.mark.parametrize("step", STEPS)
def test_a_kill_at_any_step_of_beginning_again(half, out, monkeypatch, step):
    killed_before(step, asked(half, out, 9.0), monkeypatch)
    shutil.copytree(out, other := out.with_name("other"))
    run_build(asked(half, out, 9.0), Silent())
    assert digests(out) == digests(half / "whole_9")
    run_build(asked(half, other, 7.0), Silent())
    assert digests(other) == digests(half / "whole_7")


def killed_while_published(folder: Path, monkeypatch) -> Path:
    """A dataset whose second try of a failed scene was killed when the old scenes table was gone, the new not there."""
    manifest, out = write_manifest(folder / "m.parquet", ["fine", "fine", "sad", "fine"]), folder / "out"
    build(manifest, out)
    invalidate.reopen_scenes(out, ["scene_002"])
    with monkeypatch.context() as patched:
        patched.setattr(commit, "move", die)
        with pytest.raises(Killed):
            build(manifest, out)
    assert not list((out / "scenes").iterdir())
    return out


@pytest.mark.slow  # the test below begins from the same state
def test_from_after_a_kill_while_a_shard_is_published_takes_all_of_it_back(tmp_path, monkeypatch, marks):
    out = killed_while_published(tmp_path, monkeypatch)
    marks()
    run_build(asked(tmp_path, out, 9.0), Silent())
    assert set(marks()) == {f"scene_00{i}.{stage}" for i in (0, 1, 3) for stage in ("settle", "pack")}
    run_build(asked(tmp_path, tmp_path / "fresh", 9.0, None), Silent())
    assert digests(out) == digests(tmp_path / "fresh")


def test_taking_back_after_a_kill_while_a_shard_is_published(tmp_path, monkeypatch):
    out = killed_while_published(tmp_path, monkeypatch)
    assert invalidate.reopen_scenes(out, ["scene_001"]) == 1
    found = read_build_state(out)
    assert (found.done, found.failed, found.remaining) == (2, 1, 1)


def with_other_versions(out: Path, **versions: str) -> None:
    record = json.loads((out / "run.json").read_text())
    record["versions"] |= versions
    (out / "run.json").write_text(json.dumps(record))


def test_other_code_is_refused_and_told_and_from_a_stage_it_goes_on(half, out, marks):
    run_build(asked(half, out, 7.0), Silent())
    with_other_versions(out, code="0123456789ab")
    marks()
    with pytest.raises(BuildError, match=r"versions\.code was '0123456789ab' and is now .*git pull") as refused:
        run_build(asked(half, out, 7.0, None), Silent())
    assert "add --from STAGE to compute" in str(refused.value)
    for limit in (1, None):
        run_build(replace(asked(half, out, 7.0, "export"), limit=limit), Silent())
    counts = marks()
    assert {name.partition(".")[2] for name in counts} == {"pack"}
    assert set(counts.values()) == {1}
    assert digests(out) == digests(half / "whole_7"), "run.json names the code that is here"


def test_other_packages_are_another_dataset_whatever_stage_is_named(half, out):
    with_other_versions(out, code="0123456789ab", numpy="1.0")
    for section in (None, "observe"):
        with pytest.raises(BuildError, match=r"versions\.numpy") as refused:
            run_build(asked(half, out, 7.0, section), Silent())
        assert "add --from" not in str(refused.value)


def test_recorded_answers_are_read_once(tmp_path, monkeypatch):
    manifest, answers = write_manifest(tmp_path / "m.parquet", ["fine", "fine"]), tmp_path / "answers"
    answers.mkdir()
    (answers / "scene_000.json").write_text("{}")
    reads, read_bytes = Counter[str](), Path.read_bytes

    def counted(path: Path) -> bytes:
        reads[path.name] += 1
        return read_bytes(path)

    monkeypatch.setattr(Path, "read_bytes", counted)
    config = Config(run=RunConfig(**QUICK), curate=CurateConfig(judge="replay", replay_dir=str(answers)))
    run_build(replace(request(manifest, tmp_path / "out"), config=config), Silent())
    assert reads["scene_000.json"] == 1
    assert {row["status"] for row in scenes(tmp_path / "out")} == {"done"}
