"""A scene with the picture's surroundings looks like the picture from its camera, and simulates like any other."""

import io
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from schemas.config import Config
from schemas.geometry import Camera, Pose
from schemas.objects import Evidence
from schemas.outcome import Done
from schemas.scene import CuratedScene, ExportedScene
from tableverse_factory.delivery.formats.model_contents import ModelContents, read_model_contents
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.models.services import Services
from tableverse_factory.physics.mjcf.spec import SceneFiles
from tableverse_factory.physics.render.render import Lighting, Rendering, look_at, render
from tableverse_factory.stages.export.export import export
from tests.helpers.simple_scenes import Solid, as_settled, box, curated, layout

CAMERA = Camera(300.0, 310.0, 150.0, 125.0, 320, 240)
EYE = look_at(np.array([0.1, -0.5, 0.55]), np.array([0.02, 0.0, 0.0]))
BARE = Lighting(key=(0.0, 0.0, 0.0), sky=(1.0, 1.0, 1.0), ground=(1.0, 1.0, 1.0), gloss=0.0)  # colours as they are
RED = np.array([200, 20, 20])


def photograph() -> tuple[np.ndarray, np.ndarray]:
    """A picture of smooth colours with a red thing in the middle, and its mask."""
    v, u = np.indices((240, 320))
    picture = np.stack([120 + 60 * np.sin(u / 40), 130 + 50 * np.cos(v / 30), 140 + 40 * np.sin((u + v) / 50)], axis=-1)
    mask = (np.abs(u - 150) < 25) & (np.abs(v - 125) < 25)
    picture[mask] = RED
    return picture.astype(np.uint8), mask


def make_evidence(eye: Pose = EYE) -> Evidence:
    picture, mask = photograph()
    jpg, png = io.BytesIO(), io.BytesIO()
    Image.fromarray(picture).save(jpg, "JPEG", quality=98, subsampling=0)
    Image.fromarray(np.where(mask, 7, 0).astype(np.uint16)).save(png, "PNG")
    return Evidence(jpg.getvalue(), png.getvalue(), (7,), CAMERA, eye)


def run(surroundings: str, evidence: Evidence | None) -> ExportedScene:
    settled = as_settled(layout([Solid(box(0.05, 0.05, 0.05), (0.0, 0.0, 0.025))], evidence=evidence))
    scene: CuratedScene = curated(settled)
    config = Config.model_validate({"export": {"surroundings": surroundings}})
    outcome = export(scene, config, np.random.default_rng(0), Services(Path("unused")))
    assert isinstance(outcome, Done), outcome
    return outcome.value


def read_contents(scene: ExportedScene) -> ModelContents:
    files = dict(scene.files)
    assets = {name: data for name, data in files.items() if name.startswith("assets/")}
    return read_model_contents(SceneFiles(files["scene.xml"].decode(), assets).model())


def render_surroundings(scene: ExportedScene, eye: Pose) -> Rendering:
    parts = [place_mesh(look.mesh, still.pose) for still in read_contents(scene).still for look in still.looks]
    return render(parts, CAMERA, eye, lighting=BARE, shadows=False)


@pytest.mark.parametrize("eye", [EYE, look_at(np.array([-0.6, 0.2, 0.3]), np.array([0.0, 0.05, 0.0]))])
def test_the_table_and_what_is_behind_it_look_like_the_picture(eye):
    picture, mask = photograph()
    drawn = render_surroundings(run("photograph", make_evidence(eye)), eye)
    assert set(np.unique(drawn.ids)) == {0, 1}, "table and backdrop fill the picture"
    gap = np.abs(drawn.color.astype(float) - picture).max(axis=-1)
    around = np.ones_like(mask)
    around[95:155, 120:180] = False
    assert np.median(gap[around]) < 4
    assert np.percentile(gap[around], 95) < 16, "but for the rim of the table"
    smooth = np.abs(drawn.color[mask].astype(float) - RED).sum(axis=-1)
    assert smooth.min() > 60, "nothing of the thing is left on the table"


def test_physics_and_rows_are_those_of_the_plain_scene():
    evidence = make_evidence()
    photographed, plain = run("photograph", evidence), run("plain", evidence)
    assert photographed.certificate == plain.certificate
    assert photographed.object_rows == plain.object_rows
    contents = read_contents(photographed)
    assert [still.name for still in contents.still] == ["table", "backdrop"]
    assert not contents.still[1].hulls, "nothing touches the backdrop"
    assert run("photograph", evidence).files == photographed.files


def test_a_scene_without_a_picture_has_the_plain_table():
    assert run("photograph", None).files == run("plain", None).files


def test_a_picture_that_objects_cover_whole_still_gives_a_table():
    evidence = make_evidence()
    png = io.BytesIO()
    Image.fromarray(np.full((240, 320), 7, dtype=np.uint16)).save(png, "PNG")
    covered = Evidence(evidence.color_jpg, png.getvalue(), (7,), CAMERA, EYE)
    assert "assets/backdrop.png" in dict(run("photograph", covered).files)
