"""What an estimate stands on: scenes of committed shards and of journals, dropped ones, what was kept from before."""

import json
from dataclasses import replace

import numpy as np
import pytest

from tests.helpers.builds import Silent, build, request, write_manifest
from workers.progress.stage_costs import collect_measurements
from workers.run import run_build

pytestmark = pytest.mark.heavy

POOL_OF = {"look": "perception", "cut": "geometry", "fall": "physics", "pack": "curation"}
NAMES = ["slow_0.2", "empty", "sad", "fell"] * 14


@pytest.fixture(scope="module")
def begun(tmp_path_factory):
    """56 scenes in shards of 4, the last two of which are not done."""
    folder = tmp_path_factory.mktemp("begun")
    manifest = write_manifest(folder / "m.parquet", NAMES)
    run_build(replace(request(manifest, folder / "out"), limit=54), Silent())
    return folder / "out"


def test_every_scene_counts_with_what_it_took(begun):
    found = collect_measurements(begun, POOL_OF)
    assert found.scenes == 54
    stages = {stage.name: stage for stage in found.stages}
    assert list(stages) == ["look", "cut", "fall", "pack"]
    assert stages["cut"].pool == "geometry"
    slow, dropped = NAMES.count("slow_0.2"), NAMES.count("empty")
    assert np.sort(stages["cut"].wall_s)[-slow:].min() >= 0.2
    assert (stages["cut"].wall_s == 0).sum() == dropped, "dropped before: they count with nothing"
    assert (stages["pack"].wall_s > 0).sum() == slow
    assert found.notes == ()


def test_storage_is_that_of_whole_shards(begun):
    found = collect_measurements(begun, POOL_OF)
    on_disk = sum(path.stat().st_size for path in (begun / "mjcf").iterdir())
    assert len(found.storage["scenes"]) == 52
    assert 0.6 * on_disk < found.storage["scenes"].sum() < on_disk, "all but the ends of the archives"
    tables = sum(p.stat().st_size for f in ("scenes", "objects", "tasks", "timings") for p in (begun / f).iterdir())
    assert found.storage["tables"].sum() == pytest.approx(tables)
    assert found.storage["stage records"].sum() > 0


def test_what_was_kept_from_before_counts_with_the_mean_of_the_others(tmp_path):
    manifest, out = (
        write_manifest(tmp_path / "m.parquet", ["slow_0.3", "slow_0.1", *["slow_0.2"] * 6]),
        tmp_path / "out",
    )
    tally = build(manifest, out).tally
    folders = ("mjcf", "scenes", "objects", "tasks", "timings")
    on_disk = sum(path.stat().st_size for folder in folders for path in (out / folder).iterdir())
    assert on_disk - 2 * 11_000 < tally.bytes_committed <= on_disk, "all but the ends of two archives"
    before = {stage.name: stage for stage in collect_measurements(out, POOL_OF).stages}
    (out / "scenes" / "shard-00001.parquet").unlink()
    build(manifest, out)
    found = collect_measurements(out, POOL_OF)
    after = {stage.name: stage for stage in found.stages}
    assert after["cut"].wall_s[:4] == pytest.approx(before["cut"].wall_s[:4])
    assert after["cut"].wall_s[4:] == pytest.approx([before["cut"].wall_s[:4].mean()] * 4)
    assert "cut: 4 scenes began with what was kept of it and count with the others' mean" in found.notes


def test_a_stage_of_which_nothing_is_known_is_said(tmp_path):
    manifest, out = write_manifest(tmp_path / "m.parquet", ["fine"] * 4), tmp_path / "out"
    build(manifest, out)
    (out / "scenes" / "shard-00000.parquet").unlink()
    build(manifest, out)
    found = collect_measurements(out, POOL_OF)
    assert [stage.name for stage in found.stages] == ["pack"]
    assert "cut: no timings here, so it is not counted" in found.notes


def test_a_stage_that_is_unknown_here_is_said(begun):
    assert any("no stage of this version" in note for note in collect_measurements(begun, {}).notes)


def test_the_command_for_people_and_for_scripts(begun, capsys, monkeypatch):
    from tableverse_factory.cli.main import main

    def run(*arguments: str) -> tuple[int, str, str]:
        monkeypatch.setattr("sys.argv", ["tableverse", "estimate", str(begun), *arguments])
        monkeypatch.setenv("COLUMNS", "100")
        with pytest.raises(SystemExit) as ended:
            main()
        captured = capsys.readouterr()
        return ended.value.code or 0, captured.out, captured.err

    options = ("--scenes", "100000", "--cluster", "cpus=64", "--price", "cpu_hour=0.04", "--price", "gb_month=0.02")
    code, text, _ = run(*options)
    assert code == 0
    for words in ("100000 scenes, estimated from 54", "wall time on 64 CPUs", "cost of machines", "cut "):
        assert words in text
    found = json.loads(run(*options, "--json")[1])
    assert found["wall_hours"]["value"] == pytest.approx(found["cpu_hours_held"]["value"] / 64)
    assert found["wall_hours"]["low"] < found["wall_hours"]["value"] < found["wall_hours"]["high"]
    wall_s = sum(wall["value"] for _, wall in found["stages"].values())
    assert found["cpu_hours_held"]["value"] == pytest.approx(wall_s * 100000 / 3600)
    for wrong in (("--cluster", "gpus=4"), ("--cluster", "cpu=4"), ("--price", "gold=1")):
        code, _, errors = run("--scenes", "10", *wrong)
        assert code == 1
        assert errors.startswith(f"error: {wrong[0]} ")
    assert run("--scenes", "0")[0] == 2


def test_a_small_build_is_refused(tmp_path):
    from schemas.pools import Pools
    from tableverse_factory.core.errors import BuildError
    from tableverse_factory.dataset.cost_estimate import estimate_cost

    build(write_manifest(tmp_path / "m.parquet", ["fine"]), tmp_path / "out")
    with pytest.raises(BuildError, match="1 scenes with timings are too few"):
        estimate_cost(collect_measurements(tmp_path / "out", POOL_OF), 100, Pools(), None, {})
