"""Cousins: each accounted for, with its parent and changes in its row, and the same bytes however they are built."""

import json
import shutil
from pathlib import Path

import mujoco
import numpy as np
import pyarrow.parquet as pq
import pytest

from schemas.config import Config
from schemas.cousins import Change, Donor, Recipe, parse_recipe
from schemas.manifest import SceneKind
from schemas.outcome import Dropped
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.cousin_rows import THEMES, digest_objects, list_cousins
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.dataset.shard_plan import read_plan
from tableverse_factory.dataset.splits import find_split
from tableverse_factory.evaluation.bench.cousins import measure_cousins
from tableverse_factory.evaluation.verify import verify_scenes
from tableverse_factory.models.services import Services
from tableverse_factory.rebuild import manifest_from_dataset
from tableverse_factory.run_record import read_run
from tableverse_factory.sources.manifest import write_manifest
from tableverse_factory.stages.cousins.derive import derive_cousin
from tableverse_factory.stages.curate.lexicon import find_kind
from tableverse_factory.viz.gallery.gallery import write_gallery
from tests.helpers.builds import Silent, digests
from tests.helpers.cousin_parents import SCENES, build_parents, make_request
from workers.run import run_build

pytestmark = pytest.mark.heavy
PER_SCENE = 3


def plan(parents: Path, per_scene: int = PER_SCENE, seed: int = 0) -> list:
    return list(list_cousins(open_dataset(parents), per_scene, seed, find_kind))


def build(folder: Path, name: str, **changes: object) -> Path:
    run_build(make_request(folder / "cousins.parquet", folder / name, **changes), Silent())
    return folder / name


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Path:
    """A folder with the dataset `out`, the manifest of its cousins, and `cousins` built from it."""
    folder = tmp_path_factory.mktemp("made")
    write_manifest(folder / "cousins.parquet", plan(build_parents(folder)))
    build(folder, "cousins")
    return folder


def rows_of(out: Path) -> list[dict]:
    return open_dataset(out).scenes.to_table().to_pylist()


def test_every_scene_has_its_cousins_and_every_cousin_its_row(made):
    parents, rows = rows_of(made / "out"), rows_of(made / "cousins")
    assert len(parents) == len(SCENES)
    assert len(rows) == PER_SCENE * len(parents)
    assert {row["status"] for row in rows} <= {"done", "dropped"}
    assert sum(row["status"] == "done" for row in rows) >= 0.9 * len(rows)
    for row in rows:
        (parent,) = (its for its in parents if its["scene_id"] == row["parent"])
        assert row["kind"] == SceneKind.COUSIN.value
        assert (row["licence"], row["source"]) == (parent["licence"], parent["source"])
        assert parse_recipe(row["recipe"]).changes
        assert bool(row["changes"]) == (row["status"] == "done")
        assert row["reason"] or row["status"] == "done"


def test_families_stay_together_in_every_split(made):
    """Things are borrowed within the split, too."""
    split_of = {row["scene_id"]: row["split"] for row in rows_of(made / "out")}
    for row in rows_of(made / "out"):
        assert (row["family"], row["parent"], row["changes"]) == (row["scene_id"], None, None)
    for row in rows_of(made / "cousins"):
        assert row["family"] == row["parent"]
        assert row["split"] == split_of[row["parent"]] == find_split(row["family"])
        donors = parse_recipe(row["recipe"]).donors
        assert {split_of[donor.scene_id] for donor in donors} <= {row["split"]}
        assert row["parent"] not in {donor.scene_id for donor in donors}
        assert len({(donor.scene_id, donor.object_id) for donor in donors}) == len(donors)


def test_cousins_of_cousins_are_of_the_same_family(made):
    done = {row["scene_id"]: row["family"] for row in rows_of(made / "cousins") if row["status"] == "done"}
    grandchildren = plan(made / "cousins", 1)
    assert {row.parent for row in grandchildren} == set(done)
    assert all(row.family == done[row.parent] for row in grandchildren)


def test_the_manifest_depends_on_dataset_and_seed_alone(made):
    first = plan(made / "out")
    assert first == plan(made / "out")
    assert [row for row in plan(made / "out", 2 * PER_SCENE) if row in first] == first, "more cousins, the same first"
    assert not {row.scene_id for row in first} & {row.scene_id for row in plan(made / "out", seed=1)}
    asked = {parse_recipe(row.recipe).changes for row in first}
    assert asked <= {*THEMES, (Change.TURN, Change.MOVE)}, "what has no donors is turned instead"
    assert all(Change.MOVE in changes for changes in asked)


def test_changes_are_what_differs_from_the_parent(made):
    """Ids stay, so that what a row says can be read off the objects."""
    parents, cousins = open_dataset(made / "out"), open_dataset(made / "cousins")
    for row in rows_of(made / "cousins"):
        if row["status"] != "done":
            continue
        before = {item["object_id"]: item for item in parents.scene(row["parent"]).object_rows()}
        after = {item["object_id"]: item for item in cousins.scene(row["scene_id"]).object_rows()}
        said = [
            (change, name)
            for change, _, names in (line.partition("=")[0].partition(":") for line in row["changes"])
            for name in names.split("+")
        ]
        assert set(before) - set(after) == {name for change, name in said if change == "remove"}
        assert set(after) <= set(before)
        for name in after.keys() - {name for _, name in said} if "mirror" not in row["changes"] else ():
            moved = np.hypot(*(after[name][key] - before[name][key] for key in ("x_m", "y_m")))
            assert moved < 0.01, f"{row['scene_id']}: {name} moved, and the row says nothing of it"
        scaled = {name for change, name in said if change == "scale"}
        for name in scaled:
            assert after[name]["size_z_m"] != pytest.approx(before[name]["size_z_m"], rel=0.05)


def test_cousins_keep_the_colours_of_their_parents_and_load_in_plain_mujoco(made, tmp_path):
    cousins = open_dataset(made / "cousins")
    row = next(row for row in rows_of(made / "cousins") if row["status"] == "done" and not row["recipe"].count("swap"))
    scene, parent = cousins.scene(row["scene_id"]), open_dataset(made / "out").scene(row["parent"])
    names = {name for name in scene.files() if name.startswith("assets/obj_") and name.endswith(".png")}
    assert names
    assert all(scene.files()[name] == parent.files()[name] for name in names)
    scene.extract(tmp_path / "scene")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene" / "scene.xml"))
    assert model.nbody == row["n_objects"] + 2


def test_the_certificates_hold(made):
    audits = list(verify_scenes(str(made / "cousins"), 1))
    assert audits
    assert [audit.problems for audit in audits if audit.problems] == []


@pytest.mark.slow  # builds of other pipelines resume by the same code
def test_stopped_and_gone_on_with_gives_the_same_bytes(made):
    for limit in (2, 5, None):
        build(made, "in-steps", limit=limit)
    assert digests(made / "in-steps") == digests(made / "cousins")
    summary = run_build(make_request(made / "cousins.parquet", made / "in-steps"), Silent())
    assert summary.tally.before == summary.tally.total


def test_rows_are_restored_from_the_dataset(made):
    """As `tableverse trajectories` does, which has no manifest."""
    out = made / "cousins"
    assert list(manifest_from_dataset(out, read_run(out / "run.json"), read_plan(out / "plan.parquet"))) == plan(
        made / "out"
    )


@pytest.mark.slow  # one more build
def test_a_dataset_that_was_built_anew_is_noticed(made, tmp_path):
    """The rows name what they were planned with."""
    shutil.copytree(made / "out", tmp_path / "out")
    rows = [row.model_copy(update={"uri": str(tmp_path / "out")}) for row in plan(made / "out", 1)]
    wrong = [row.model_copy(update={"content_sha256": "0" * 64}) for row in rows]
    write_manifest(tmp_path / "cousins.parquet", wrong)
    assert {row["reason"] for row in rows_of(build(tmp_path, "dropped"))} == {"content_changed"}


def test_a_digit_of_a_mesh_that_changed_fails_its_cousins(made, tmp_path):
    """It would otherwise be certified anew, under digests of its own."""
    shutil.copytree(made / "out", tmp_path / "out")
    for tar in (tmp_path / "out" / "mjcf").glob("*.tar"):
        content = bytearray(tar.read_bytes())
        start = content.index(b"\nv ") + 3
        place = next(k for k in range(start, start + 40) if content[k : k + 1].isdigit())
        content[place] = ord("1") if content[place] != ord("1") else ord("2")
        tar.write_bytes(bytes(content))
    rows = [row.model_copy(update={"uri": str(tmp_path / "out")}) for row in plan(made / "out", 1)]
    write_manifest(tmp_path / "cousins.parquet", rows)
    failed = [row for row in rows_of(build(tmp_path, "dest")) if row["status"] == "failed"]
    assert failed
    assert all("is not the file that was exported" in row["detail"] for row in failed)


@pytest.mark.slow  # three builds
def test_cousins_of_a_damaged_parent_fail_and_are_made_once_it_is_restored(made, tmp_path, run):
    """A cut tar, as by a full disk, is no property of the scene: it must not pass for a finished dataset."""
    shutil.copytree(made / "out", tmp_path / "out")
    parents, dest = rows_of(tmp_path / "out"), tmp_path / "dest"
    last = max(parents, key=lambda row: (row["shard"], row["tar_offset"]))
    tar = tmp_path / "out" / "mjcf" / f"shard-{last['shard']:05d}.tar"
    whole = tar.read_bytes()
    tar.write_bytes(whole[: last["tar_offset"] + 1000])
    command = ("cousins", tmp_path / "out", dest, "--per-scene", 1, "--executor", "local")
    code, text, _ = run(*command)
    assert (code, "1 failed of 3 scenes" in text) == (3, True), text
    (failed,) = (row for row in rows_of(dest) if row["status"] == "failed")
    assert (failed["parent"], failed["stage"], failed["error_kind"]) == (
        last["scene_id"],
        "derive_cousin",
        "InputError",
    )
    assert "cut short" in failed["detail"]
    tar.write_bytes(whole)
    assert run("failures", dest, "--retry")[0] == 0
    code, text, _ = run(*command)
    assert code == 0, text
    assert {row["status"] for row in rows_of(dest)} == {"done"}


@pytest.mark.slow  # two builds; test_commands.py puts scenes back
def test_lost_cousins_are_put_back_for_the_command_that_made_them(made, tmp_path, run):
    """Also those of an open shard, whose rows are in its journal."""
    rows = [row.model_copy(update={"content_sha256": "0" * 64}) for row in plan(made / "out", 2)]
    write_manifest(tmp_path / "cousins.parquet", rows)
    for limit, shards in ((1, "1 shard"), (None, "2 shards")):
        build(tmp_path, "dest", limit=limit)
        code, text, errors = run("failures", tmp_path / "dest", "--reason", "content_changed", "--retry")
        assert code == 0, errors
        assert f"in {shards} put back: run the same `tableverse cousins` to try again" in text


def test_unfinished_datasets_have_no_cousins(made, tmp_path):
    shutil.copytree(made / "out", tmp_path / "out")
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    run["manifest"]["scenes"] += 1
    (tmp_path / "out" / "run.json").write_text(json.dumps(run))
    with pytest.raises(InputError, match="is not finished: 3 of 4 scenes"):
        plan(tmp_path / "out")


def test_cousins_of_a_family_differ_and_the_bench_says_so(made):
    score = measure_cousins(str(made / "cousins"), None, 1)
    assert score.of == PER_SCENE * len(SCENES)
    assert {family.parent for family in score.families} == {row["scene_id"] for row in rows_of(made / "out")}
    assert all(family.layout_m > 0.01 and family.from_parent_m > 0.01 for family in score.families)
    assert sum(family.alike for family in score.families) == 0
    assert {kind for kind, _ in score.changes} <= {change.value for change in Change}


def test_the_bench_counts_cousins_that_no_stage_was_timed_of(made, tmp_path):
    shutil.copytree(made / "cousins", tmp_path / "untimed")
    for file in (tmp_path / "untimed" / "timings").glob("*.parquet"):
        pq.write_table(pq.read_table(file).slice(0, 0), file)
    score = measure_cousins(str(tmp_path / "untimed"), 1, 1)
    assert (score.of, np.isnan(score.cpu_mean_s)) == (PER_SCENE * len(SCENES), True)


def test_the_command_writes_manifest_and_dataset(made, tmp_path, run):
    code, text, errors = run("cousins", made / "out", tmp_path / "dest", "--per-scene", 1, "--executor", "local")
    assert code == 0, errors
    assert "of 3 scenes" in text
    assert (tmp_path / "dest.parquet").is_file()
    code, text, _ = run("cousins", made / "out", tmp_path / "dest", "--per-scene", 1, "--executor", "local")
    assert "nothing was left to do" in text
    manifest = (tmp_path / "dest.parquet").read_bytes()
    code, _, errors = run("cousins", made / "out", tmp_path / "dest", "--per-scene", 3, "--executor", "local")
    assert (code, (tmp_path / "dest.parquet").read_bytes()) == (1, manifest)
    assert "dest.parquet lists other rows than 3 cousins of each scene" in errors
    photographs = tmp_path / "photographs.parquet"
    photographs.write_bytes((made / "cousins.parquet").read_bytes())
    code, _, errors = run("cousins", made / "out", tmp_path / "photographs", "--executor", "local")
    assert (code, photographs.read_bytes()) == (1, (made / "cousins.parquet").read_bytes())
    assert "or another DEST" in errors
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/notes.txt").write_text("kept")
    assert run("cousins", made / "out", tmp_path / "mine", "--executor", "local")[0] == 1
    assert not (tmp_path / "mine.parquet").exists()
    code, _, errors = run("cousins", made / "out", made / "out", "--executor", "local")
    assert code == 1
    assert "is the dataset" in errors
    assert "give a folder apart from it" in errors


def test_the_gallery_shows_a_family_side_by_side(made, tmp_path):
    write_gallery(open_dataset(made / "cousins"), tmp_path / "gallery", renders=0)
    done = [row for row in rows_of(made / "cousins") if row["status"] == "done"]
    for row in done:
        page = (tmp_path / "gallery" / "scenes" / f"{row['scene_id']}.html").read_text()
        for other in done:
            shown = f'src="../pictures/{other["scene_id"]}-sketch-s.jpg"' in page
            assert shown == (other["family"] == row["family"])
        assert (tmp_path / "gallery" / "pictures" / f"{row['scene_id']}-sketch-s.jpg").is_file()
        assert all(line in page for line in row["changes"])


def test_what_is_borrowed_comes_with_its_colours_and_its_licence(made):
    """A tea box for a cereal box, as a plan within one split would have it; another digest drops the cousin."""
    dataset = open_dataset(made / "out")
    desk, snack = (
        next(row for row in rows_of(made / "out") if row["name"] == f"{name}.json") for name in ("desk", "snack")
    )
    lent = next(row for row in dataset.scene(snack["scene_id"]).object_rows() if row["label"] == "tea box")
    lost = next(row for row in dataset.scene(desk["scene_id"]).object_rows() if row["label"] == "cereal box")
    (row,) = (its for its in plan(made / "out", 1) if its.parent == desk["scene_id"])
    where = {"scene_id": snack["scene_id"], "object_id": lent["object_id"]}
    for digest in (digest_objects([lent])[:12], "0" * 12):
        donor = Donor(replaces=lost["object_id"], digest=digest, **where)
        recipe = Recipe(changes=(Change.SWAP,), donors=(donor,)).model_dump_json()
        rng, services = np.random.default_rng(0), Services(made / "cache")
        outcome = derive_cousin(row.model_copy(update={"recipe": recipe}), Config(), rng, services)
        if digest == "0" * 12:
            assert isinstance(outcome, Dropped)
            assert outcome.reason == "content_changed"
            continue
        assert outcome.value.changes[0] == f"swap:{lost['object_id']}={snack['scene_id']}/{lent['object_id']}"
        (found,) = (item for item in outcome.value.objects if item.object_id == lost["object_id"])
        assert (found.label, found.mesh_licence) == ("tea box", "CC0-1.0")
        assert found.mesh.texture is not None or found.mesh.vertex_colors is not None
