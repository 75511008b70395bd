"""Auditing scenes: what is sound passes, what was tampered with is found; the command's exit code says which."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from schemas.config import Config
from schemas.outcome import Done
from schemas.scene import ExportedScene
from schemas.tables import TABLES
from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.shards import TarShard
from tableverse_factory.evaluation import scene_audit
from tableverse_factory.evaluation.scene_audit import audit_scene, read_scene_folder
from tableverse_factory.models.services import Services
from tableverse_factory.stages.export.export import export
from tests.helpers.simple_scenes import Solid, as_settled, ball, box, curated, layout

SOLIDS = [Solid(box(0.1, 0.08, 0.04), (0.0, 0.0, 0.02)), Solid(ball(0.03), (0.15, 0.05, 0.03))]


@pytest.fixture(scope="module")
def scene() -> ExportedScene:
    outcome = export(curated(as_settled(layout(SOLIDS))), Config(), np.random.default_rng(0), Services(Path("unused")))
    assert isinstance(outcome, Done)
    return outcome.value


def dataset_of(scene: ExportedScene, out: Path, **changes: object) -> None:
    """A dataset of this one scene, some columns of its row changed."""
    for folder in ("mjcf", *TABLES):
        (out / folder).mkdir(parents=True)
    (out / "run.json").write_text("{}")
    with (out / "mjcf/shard-00000.tar").open("wb") as file:
        tar = TarShard(file)
        offset, size = tar.add(scene)
        tar.close()
    row = {**scene.scene_row, "status": "done", "shard": 0, "tar_offset": offset, "tar_size": size, **changes}
    rows = {"scenes": [row], "objects": scene.object_rows, "tasks": scene.task_rows}
    for name, schema in TABLES.items():
        (out / name / "shard-00000.parquet").write_bytes(encode_parquet(build_table(rows.get(name, []), schema)))


def test_an_untouched_scene_passes_with_equal_figures(scene: ExportedScene) -> None:
    audit = audit_scene("scene", dict(scene.files), scene.scene_row)
    assert audit.problems == ()
    assert audit.measured["drift_m"] == scene.certificate.drift_m
    assert audit.measured["mesh_penetration_m"] == scene.certificate.mesh_penetration_m


@pytest.mark.parametrize(
    ("name", "old", "new", "found"),
    [
        ("scene.xml", b'mass="0.2"', b'mass="0.3"', "1 file changed since the export: scene.xml"),
        ("assets/obj_000.obj", b"0.0500000", b"0.0530000", "1 file changed since the export: assets/obj_000.obj"),
        ("meta.json", b'"at_rest": true', b'"at_rest": false', "at_rest: certificate says False"),
        ("meta.json", b"tableverse-scene-1", b"tableverse-scene-9", "this version reads"),
        ("meta.json", b'"certificate": {', b'"certificate": {"x": 1,', "meta.json is not of a scene"),
        ("scene.xml", b"<mujoco", b"<mojoco", "does not load"),
    ],
)
def test_tampering_is_found(scene: ExportedScene, name: str, old: bytes, new: bytes, found: str) -> None:
    files = dict(scene.files)
    assert old in files[name]
    files[name] = files[name].replace(old, new)
    assert found in "; ".join(audit_scene("scene", files).problems)


def test_a_missing_and_an_extra_file_are_found(scene: ExportedScene) -> None:
    files = dict(scene.files)
    assert "assets/more.obj" in "; ".join(audit_scene("scene", {**files, "assets/more.obj": b""}).problems)
    del files["meta.json"]
    assert not audit_scene("scene", files).ok


def test_a_row_that_says_otherwise_is_found(scene: ExportedScene) -> None:
    audit = audit_scene("scene", dict(scene.files), {**scene.scene_row, "drift_m": 0.5})
    assert audit.problems == (f"drift_m: scenes/ says 0.5, measured {scene.certificate.drift_m!r}",)


def test_verify_reads_a_dataset(scene: ExportedScene, tmp_path: Path) -> None:
    dataset_of(scene, tmp_path / "out")
    result = CliRunner().invoke(app, ["verify", str(tmp_path / "out"), "--json"])
    assert result.exit_code == 0, result.output
    report = json.loads(result.stdout)
    assert report["ok"] is True
    assert report["scenes"][0]["scene_id"] == "scene"
    assert report["scenes"][0]["at_rest"] is True


@pytest.mark.heavy
def test_verify_fails_on_a_dataset_that_lies(scene: ExportedScene, tmp_path: Path) -> None:
    dataset_of(scene, tmp_path / "out", piece_penetration_m=0.01)
    result = CliRunner().invoke(app, ["verify", str(tmp_path / "out")])
    assert result.exit_code == 1
    assert "scenes/ says 0.01" in result.stdout
    assert "0 of 1 scene verified" in result.stdout


@pytest.mark.parametrize("table", ["objects", "tasks"])
def test_verify_misses_a_table_of_a_committed_shard(scene: ExportedScene, tmp_path: Path, table: str) -> None:
    dataset_of(scene, tmp_path / "out")
    (tmp_path / "out" / table / "shard-00000.parquet").unlink()
    result = CliRunner().invoke(app, ["verify", str(tmp_path / "out")])
    assert result.exit_code == 1
    assert f"{table}/shard-00000.parquet is missing" in str(result.exception)
    assert "the same build makes the shard again" in str(result.exception)


def test_verify_reads_an_extracted_folder(scene: ExportedScene, tmp_path: Path) -> None:
    for name, data in scene.files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(data)
    result = CliRunner().invoke(app, ["verify", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert "1 of 1 scene verified" in result.stdout


@pytest.mark.parametrize(("height", "code"), [(0.0299, 0), (0.025, 1), (0.5, 1)])
def test_verify_measures_a_foreign_file(tmp_path: Path, height: float, code: int) -> None:
    xml = (
        '<mujoco><worldbody><geom type="plane" size="1 1 1"/><body name="cube" pos="0 0 {z}"><freejoint/>'
        '<geom type="box" size="0.03 0.03 0.03"/></body></worldbody></mujoco>'
    )
    (tmp_path / "theirs.xml").write_text(xml.format(z=height))
    result = CliRunner().invoke(app, ["verify", str(tmp_path / "theirs.xml"), "--json"])
    assert result.exit_code == code, result.output
    report = json.loads(result.stdout)["scenes"][0]
    assert report["bodies"] == 1
    assert report["colliding"] is (height == 0.025)
    assert report["at_rest"] is (code == 0)


@pytest.mark.parametrize("given", ["absent", "absent.xml", "notes", "mesh.obj", "layout.json"])
def test_what_cannot_be_verified_says_what_can(tmp_path: Path, given: str) -> None:
    (tmp_path / "notes").mkdir()
    (tmp_path / "mesh.obj").write_text("v 0 0 0")
    (tmp_path / "layout.json").write_text("{}")
    result = CliRunner().invoke(app, ["verify", str(tmp_path / given)])
    assert isinstance(result.exception, InputError)
    assert ("no such file or folder" in str(result.exception)) == given.startswith("absent")
    assert "give OUT of `tableverse build`, an MJCF file" in str(result.exception)


@pytest.mark.heavy
@pytest.mark.parametrize("bodies", ["", '<body><geom type="box" size=".1 .1 .1"/></body>'])
def test_nothing_that_moves_is_nothing_to_certify(tmp_path: Path, bodies: str) -> None:
    (tmp_path / "scene.xml").write_text(f"<mujoco><worldbody>{bodies}</worldbody></mujoco>")
    for path in (tmp_path / "scene.xml", tmp_path):
        result = CliRunner().invoke(app, ["verify", str(path)])
        assert result.exit_code == 1
        assert "nothing to certify: no body has a free joint" in result.stdout


def test_scenes_of_one_folder_may_share_their_meshes(tmp_path: Path) -> None:
    text = (
        '<mujoco><asset><mesh name="m" file="../meshes/m.obj"/></asset><worldbody><geom type="plane" size="1 1 1"/>'
        '<body pos="0 0 .02"><freejoint/><geom type="mesh" mesh="m"/></body></worldbody></mujoco>'
    )
    (tmp_path / "meshes").mkdir()
    trimesh.creation.box((0.04, 0.04, 0.04)).export(tmp_path / "meshes" / "m.obj")
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "scene.xml").write_text(text)
    assert "1 of 1 scene verified" in CliRunner().invoke(app, ["verify", str(tmp_path)]).stdout
    alone = CliRunner().invoke(app, ["verify", str(tmp_path / "one")])
    assert (alone.exit_code, "lies outside" in alone.stdout) == (1, True)
    wider = ["verify", str(tmp_path / "one" / "scene.xml"), "--root", str(tmp_path)]
    assert "1 of 1 scene verified" in CliRunner().invoke(app, wider).stdout


@pytest.mark.parametrize("scenes", ["a folder", "a file"])
def test_an_entry_called_scenes_makes_no_dataset(tmp_path: Path, scenes: str) -> None:
    if scenes == "a folder":
        (tmp_path / "scenes").mkdir()
    else:
        (tmp_path / "scenes").write_text("one")
    result = CliRunner().invoke(app, ["verify", str(tmp_path)])
    assert "nothing there can be verified" in str(result.exception)
    (tmp_path / "one").mkdir()
    (tmp_path / "one" / "scene.xml").write_text(
        '<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 .0299"><freejoint/>'
        '<geom type="box" size=".03 .03 .03"/></body></worldbody></mujoco>'
    )
    assert "1 of 1 scene verified" in CliRunner().invoke(app, ["verify", str(tmp_path)]).stdout


def test_a_folder_is_read_within_bounds(scene: ExportedScene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "one"
    for name, data in scene.files:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    (tmp_path / "secret").write_bytes(b"x")
    (folder / "link").symlink_to(tmp_path / "secret")
    assert read_scene_folder(folder) == dict(scene.files)
    monkeypatch.setattr(scene_audit, "MAX_SCENE_FILES", 2)
    result = CliRunner().invoke(app, ["verify", str(folder)])
    assert result.exit_code == 1
    assert "more than 2 files" in result.stdout
