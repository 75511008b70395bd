"""A composite through the line: every copy an object of its own, in rows, files, phrases and certificate."""

import json
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from schemas.config import Config
from schemas.geometry import Pose
from schemas.objects import PlacedObject, PlacedObjects, Table
from schemas.outcome import Done
from schemas.scene import ExportedScene
from tableverse_factory.core.seeding import make_rng
from tableverse_factory.evaluation.scene_audit import audit_scene
from tableverse_factory.models.services import Services
from tableverse_factory.sources.synthetic import food, packages, vessels
from tableverse_factory.sources.synthetic.model import GeneratedObject
from tableverse_factory.stages.curate.curate import curate
from tableverse_factory.stages.export.export import export
from tableverse_factory.stages.rectify.rectify import rectify
from tableverse_factory.stages.settle import settle
from tests.helpers.simple_scenes import Solid, as_settled, box, curated, layout

pytestmark = pytest.mark.heavy

COPIES = 4


@pytest.fixture(scope="module")
def bowl_of_lemons(tmp_path_factory: pytest.TempPathFactory) -> ExportedScene:
    """A bowl with one lemon seen and four counted, and a block beside it."""

    def thing(
        name: str, label: str, model: GeneratedObject, at: tuple[float, float, float], **more: Any
    ) -> PlacedObject:
        pose = Pose(np.array(at), np.array([1.0, 0.0, 0.0, 0.0]))
        return PlacedObject(name, label, 1.0, model.mesh, more.pop("scale", 1.0), pose, **more)

    bowl, lemon = vessels.make_bowl(np.random.default_rng(0)), food.make_lemon(np.random.default_rng(1))
    things = (
        thing("bowl", "bowl", bowl, (0.0, 0.0, 0.0)),
        thing(
            *("lemon", "lemon", lemon, (0.0, 0.0, 0.03)),
            contained_in="bowl",
            count=COPIES,
            scale=0.6,
            mesh_licence="MIT",
        ),
        thing("block", "wooden block", packages.make_wooden_block(np.random.default_rng(0)), (0.16, 0.0, 0.0)),
    )
    table = Table(np.zeros(2), np.array([0.3, 0.2]), 0.0, (150, 120, 90), 0.0)
    item: Any = PlacedObjects("lemons", table, things)
    services = Services(tmp_path_factory.mktemp("cache"))
    for stage in (rectify, settle, curate, export):
        outcome = stage(item, Config(), make_rng(0, "lemons", stage.__name__), services)
        assert isinstance(outcome, Done), (stage.__name__, outcome)
        item = outcome.value
    assert isinstance(item, ExportedScene)
    return item


def meta_of(scene: ExportedScene) -> dict[str, Any]:
    content: dict[str, Any] = json.loads(dict(scene.files)["meta.json"])
    return content


def test_every_copy_is_a_body_with_a_free_joint_and_a_mass(bowl_of_lemons: ExportedScene) -> None:
    files = dict(bowl_of_lemons.files)
    model = mujoco.MjModel.from_xml_string(files["scene.xml"].decode(), {k: v for k, v in files.items() if "/" in k})
    for name in ("lemon", *(f"lemon_{k}" for k in range(2, COPIES + 1))):
        assert model.joint(name).type == mujoco.mjtJoint.mjJNT_FREE
        assert float(model.body(name).mass[0]) == pytest.approx(float(model.body("lemon").mass[0]))


def test_the_licence_of_a_models_mesh_stands_with_every_object_that_has_it(bowl_of_lemons: ExportedScene) -> None:
    said = {row["object_id"]: row["mesh_licence"] for row in bowl_of_lemons.object_rows}
    assert said == {entry["object_id"]: entry["mesh_licence"] for entry in meta_of(bowl_of_lemons)["objects"]}
    assert {name for name, licence in said.items() if licence == "MIT"} == {n for n in said if n.startswith("lemon")}
    assert said["bowl"] is None
    assert bowl_of_lemons.scene_row["mesh_licences"] == ["MIT"]


def test_rows_and_meta_say_what_is_a_copy_and_claim_no_displacement_for_it(bowl_of_lemons: ExportedScene) -> None:
    rows = {row["object_id"]: row for row in bowl_of_lemons.object_rows}
    objects = {entry["object_id"]: entry for entry in meta_of(bowl_of_lemons)["objects"]}
    assert rows.keys() == objects.keys()
    assert len(rows) == 2 + COPIES
    for name, row in rows.items():
        is_copy = name.startswith("lemon_")
        assert (row["copy_of"] == "lemon") == is_copy
        assert (row["displacement_m"] is None) == is_copy
        assert (objects[name]["poses"]["placed"] is None) == is_copy
        assert row["contained_in"] == ("bowl" if name.startswith("lemon") else None)
    groups = [entry["group"] for entry in objects.values() if entry["contained_in"] == "bowl"]
    assert set(groups) == {objects["bowl"]["group"]}
    assert bowl_of_lemons.scene_row["settle_time_s"] == meta_of(bowl_of_lemons)["settle_time_s"] > 0.0
    assert meta_of(bowl_of_lemons)["rectified_by"] == Config().rectify.method


def test_the_certificate_holds_and_verify_finds_the_same(bowl_of_lemons: ExportedScene) -> None:
    certificate = bowl_of_lemons.certificate
    assert certificate.at_rest
    assert (certificate.left_container, certificate.fell, certificate.colliding) == ((), (), False)
    assert audit_scene("lemons", dict(bowl_of_lemons.files), bowl_of_lemons.scene_row).problems == ()


def test_phrases_tell_copies_apart_or_are_not_given(bowl_of_lemons: ExportedScene) -> None:
    phrases = [(p, row["object_id"]) for row in bowl_of_lemons.object_rows for p in row["distinguishing_phrases"]]
    assert len({phrase for phrase, _ in phrases}) == len(phrases)
    assert not {"the lemon", "the lemon in the bowl"} & {phrase for phrase, _ in phrases}
    ids = {row["object_id"] for row in bowl_of_lemons.object_rows}
    for task in bowl_of_lemons.task_rows:
        assert {task["x_id"], task["y_id"]} <= ids


def test_a_content_that_ended_beside_its_container_is_named_and_no_longer_in_it(tmp_path: Path) -> None:
    tray, cube = box(0.12, 0.12, 0.01), box(0.03, 0.03, 0.03)
    solids = [
        Solid(tray, (0.0, 0.0, 0.005), "tray"),
        Solid(cube, (0.02, 0.0, 0.0255), "cube", contained_in="obj_000"),
        Solid(cube, (0.15, 0.0, 0.0155), "cube", contained_in="obj_000"),
    ]
    outcome = export(curated(as_settled(layout(solids))), Config(), make_rng(0, "scene", "export"), Services(tmp_path))
    assert isinstance(outcome, Done)
    scene = outcome.value
    assert scene.certificate.left_container == ("obj_002",)
    assert scene.scene_row["n_left_container"] == 1
    assert [row["contained_in"] for row in scene.object_rows] == [None, "obj_000", None]
    entries = meta_of(scene)["objects"]
    assert [entry["contained_in"] for entry in entries] == [None, "obj_000", None]
    assert [entry["placed_in"] for entry in entries] == [None, "obj_000", "obj_000"]
    assert audit_scene("scene", dict(scene.files), scene.scene_row).problems == ()
