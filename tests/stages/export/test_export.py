"""The stage export: files that load anywhere, figures that are true, and nothing that moves or collides."""

import io
import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
from PIL import Image

from schemas.codec import decode, encode
from schemas.config import Config
from schemas.curation import TaskAssessment
from schemas.geometry import Camera, Pose, TriangleMesh
from schemas.objects import Evidence
from schemas.outcome import Done, Dropped, Outcome
from schemas.scene import CuratedScene, ExportedScene
from tableverse_factory.dataset.scene_meta import read_meta
from tableverse_factory.dataset.shards import check_exported
from tableverse_factory.models.services import Services
from tableverse_factory.stages.export.export import export
from tests.helpers.simple_scenes import UPRIGHT, Solid, as_settled, ball, box, curated, cylinder, layout

HOSTILE = '"/><x a="&lt;\u202e]]>'
TASK = TaskAssessment(
    task_id="task_000", instruction=f"put {HOSTILE} on it", x_id="obj_000", y_id="obj_001", relation="on",
    source="rules", accepted=True,
)  # fmt: skip
SOLIDS = [
    Solid(box(0.1, 0.08, 0.04), (0.0, 0.0, 0.02), label=HOSTILE),
    Solid(cylinder(0.03, 0.06, 24), (0.0, 0.0, 0.0702), contained_in="obj_000"),
    Solid(ball(1.0), (0.15, 0.05, 0.03), scale=0.03),
]


def run(scene: CuratedScene, poses: str = "settled") -> Outcome[ExportedScene]:
    config = Config.model_validate({"export": {"poses": poses}})
    return export(scene, config, np.random.default_rng(0), Services(Path("unused")))


def exported(scene: CuratedScene) -> ExportedScene:
    outcome = run(scene)
    assert isinstance(outcome, Done), outcome
    return outcome.value


@pytest.fixture(scope="module")
def scene() -> ExportedScene:
    return exported(curated(as_settled(layout(SOLIDS)), tasks=(TASK,)))


def model_of(scene: ExportedScene) -> mujoco.MjModel:
    files = dict(scene.files)
    assets = {name: data for name, data in files.items() if name.startswith("assets/")}
    return mujoco.MjModel.from_xml_string(files["scene.xml"].decode(), assets)


@pytest.mark.heavy
def test_the_executor_can_commit_it(scene: ExportedScene) -> None:
    check_exported(scene, "scene")
    assert encode(decode(encode(scene))) == encode(scene)


def test_masses_are_the_judges_and_inertia_follows(scene: ExportedScene) -> None:
    model = model_of(scene)
    masses = [model.body(f"obj_{k:03d}").mass[0] for k in range(3)]
    np.testing.assert_allclose(masses, [0.2, 0.22, 0.24], rtol=1e-9)
    x, y, z = 0.1, 0.08, 0.04
    expected = 0.2 / 12 * np.array([x * x + y * y, x * x + z * z, y * y + z * z])
    np.testing.assert_allclose(np.sort(model.body("obj_000").inertia)[::-1], expected, rtol=1e-5)


def test_rows_meta_and_xml_agree(scene: ExportedScene) -> None:
    model, meta = model_of(scene), json.loads(dict(scene.files)["meta.json"])
    for k, (row, entry) in enumerate(zip(scene.object_rows, meta["objects"], strict=True)):
        start = 7 * k
        stored = entry["poses"]["settled"]
        assert row["object_id"] == entry["object_id"] == model.body(k + 2).name
        assert [row[c] for c in ("x_m", "y_m", "z_m")] == stored["position"] == model.qpos0[start : start + 3].tolist()
        np.testing.assert_allclose(model.qpos0[start + 3 : start + 7], stored["quaternion_wxyz"], atol=1e-12)
    assert scene.object_rows[0]["volume_m3"] == pytest.approx(0.1 * 0.08 * 0.04)
    assert [scene.object_rows[2][f"size_{axis}_m"] for axis in "xyz"] == pytest.approx([0.06] * 3, abs=4e-3)
    assert scene.scene_row["drift_m"] == scene.certificate.drift_m == meta["certificate"]["drift_m"]
    assert read_meta(dict(scene.files)["meta.json"]).certificate == scene.certificate


@pytest.mark.heavy
def test_quality_of_pieces_is_recorded_at_the_size_of_the_exported_object() -> None:
    settled = as_settled(layout([Solid(ball(1.0), (0.0, 0.0, 0.03), scale=0.03)]))
    pieces = replace(
        settled.rectified.pieces[0], hausdorff_m=0.1, uncovered_m=0.02, cavity_kept=0.75, repaired="filled"
    )
    scene = exported(curated(replace(settled, rectified=replace(settled.rectified, pieces=(pieces,)))))
    row, entry = scene.object_rows[0], json.loads(dict(scene.files)["meta.json"])["objects"][0]["pieces"]
    assert (row["piece_hausdorff_m"], row["piece_uncovered_m"]) == pytest.approx((0.003, 0.0006))
    assert (row["cavity_kept"], row["piece_method"], row["mesh_repaired"]) == (0.75, "convex", "filled")
    assert (entry["hausdorff_m"], entry["uncovered_m"]) == pytest.approx((0.003, 0.0006))
    assert (entry["cavity_kept"], entry["method"], entry["repaired"]) == (0.75, "convex", "filled")


def test_the_certificate_of_a_quiet_scene(scene: ExportedScene) -> None:
    certificate = scene.certificate
    assert certificate.at_rest
    assert not certificate.colliding
    assert certificate.drift_m < 1e-3
    assert max(certificate.piece_penetration_m, certificate.mesh_penetration_m) < 2e-4
    assert certificate.left_container == ()
    assert [name for name, _ in certificate.displacement_m] == ["obj_000", "obj_001", "obj_002"]


def test_hostile_labels_survive_in_json_and_stay_out_of_the_xml(scene: ExportedScene) -> None:
    files = dict(scene.files)
    assert json.loads(files["meta.json"])["objects"][0]["label"] == HOSTILE
    assert b"<x" not in files["scene.xml"]
    assert scene.object_rows[0]["label"] == HOSTILE
    assert scene.task_rows[0]["instruction"] == TASK.instruction


@pytest.mark.heavy
def test_equal_scenes_give_equal_bytes(scene: ExportedScene) -> None:
    assert encode(exported(curated(as_settled(layout(SOLIDS)), tasks=(TASK,)))) == encode(scene)


def test_loads_from_the_extracted_folder(scene: ExportedScene, tmp_path: Path) -> None:
    for name, data in scene.files:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_bytes(data)
    assert mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml")).nbody == 5


def test_a_planted_collision_of_meshes_never_leaves() -> None:
    # Pieces that are 3 mm too small on every side: the simulation feels nothing, the meshes overlap.
    small = box(0.04, 0.04, 0.044)
    solids = [
        Solid(box(0.05, 0.05, 0.044), (0.0, 0.0, 0.022), hulls=(small,)),
        Solid(box(0.05, 0.05, 0.044), (0.047, 0.0, 0.022), hulls=(small,)),
    ]
    outcome = run(curated(as_settled(layout(solids))))
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "colliding"
    assert "3.00 mm (obj_000 & obj_001)" in outcome.detail


@pytest.mark.parametrize(("poses", "depth_m"), [("placed", 0.01), ("rectified", 0.004)])
def test_a_scene_that_is_not_settled_is_written_as_it_is_and_not_certified(poses: str, depth_m: float) -> None:
    side = 0.05
    before = layout([Solid(box(side, side, side), (x, 0.0, side / 2)) for x in (0.0, side - 0.01)])
    between = replace(before.poses[1], position=np.array([side - 0.004, 0.0, side / 2]))
    settled = replace(as_settled(replace(before, poses=(before.poses[0], between))), poses=before.poses)
    outcome = run(curated(settled), poses)
    assert isinstance(outcome, Done)
    assert outcome.value.object_rows[1]["x_m"] == pytest.approx(side - depth_m)
    assert outcome.value.certificate.piece_penetration_m == pytest.approx(depth_m, abs=1e-6)
    assert outcome.value.scene_row["colliding"]
    assert not outcome.value.scene_row["usable"]
    assert not outcome.value.scene_row["at_rest"]


def test_a_planted_collision_of_pieces_is_pushed_apart_or_refused() -> None:
    solids = [Solid(box(0.05, 0.05, 0.05), (0.0, 0.0, 0.025)), Solid(box(0.05, 0.05, 0.05), (0.047, 0.0, 0.025))]
    outcome = run(curated(as_settled(layout(solids))))
    if isinstance(outcome, Done):
        assert outcome.value.certificate.piece_penetration_before_m == pytest.approx(0.003, abs=2e-4)
        assert outcome.value.certificate.mesh_penetration_before_m == pytest.approx(0.003, abs=2e-4)
        assert outcome.value.certificate.piece_penetration_m < 1e-3
    else:
        assert isinstance(outcome, Dropped)


def test_what_topples_on_its_true_mass_settles_again() -> None:
    dropped_high = [Solid(box(0.05, 0.05, 0.05), (0.0, 0.0, 0.028))]
    certificate = exported(curated(as_settled(layout(dropped_high)))).certificate
    assert certificate.at_rest
    assert dict(certificate.displacement_m)["obj_000"] == pytest.approx(0.003, abs=2e-4)


@pytest.mark.heavy
def test_a_scene_whose_object_leaves_the_table_is_dropped() -> None:
    far = as_settled(layout(SOLIDS))
    poses = (*far.poses[:2], Pose(np.array([5.0, 0.0, 0.03]), UPRIGHT))
    outcome = run(curated(type(far)(far.scene_id, far.rectified, poses, 0.2)))
    assert isinstance(outcome, Dropped)
    assert outcome.reason == "object_fell"
    assert "obj_002" in outcome.detail


def test_a_picture_becomes_textures_camera_and_observation() -> None:
    cube = box(0.05, 0.05, 0.05)
    grey = TriangleMesh(cube.vertices, cube.faces, np.full((8, 3), 99, dtype=np.uint8))
    jpg, png = io.BytesIO(), io.BytesIO()
    Image.new("RGB", (320, 240), (250, 0, 0)).save(jpg, "JPEG")
    Image.fromarray(np.full((240, 320), 5, dtype=np.uint16)).save(png, "PNG")
    above = Pose(np.array([0.0, 0.0, 0.5]), np.array([0.0, 1.0, 0.0, 0.0]))
    evidence = Evidence(jpg.getvalue(), png.getvalue(), (5,), Camera(500, 500, 159.5, 119.5, 320, 240), above)
    settled = as_settled(layout([Solid(grey, (0, 0, 0.025))], evidence=evidence))
    scene = exported(curated(settled))
    files = dict(scene.files)
    assert files["observation/color.jpg"] == jpg.getvalue()
    assert files["observation/masks.png"] == png.getvalue()
    texture = np.asarray(Image.open(io.BytesIO(files["assets/obj_000.png"])))
    assert (texture[..., 0] > 230).any()
    assert (texture == 99).all(axis=2).any()
    model = model_of(scene)
    assert model.ntex == 3  # the sky, the table and this
    assert model.geom("obj_000").matid[0] == model.material("obj_000").id
    assert model.cam("observation").id == 0
    assert json.loads(files["meta.json"])["objects"][0]["mask_value"] == 5
