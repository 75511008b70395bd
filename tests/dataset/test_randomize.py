"""Another look: the dataset stays as it is, bodies and masses too; bounds hold; what cannot be changed is said."""

import json
import subprocess
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
from typer.testing import CliRunner

from schemas.geometry import Camera, Pose
from schemas.scene import ExportedScene
from schemas.tables import TABLES
from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.png import encode_png
from tableverse_factory.core.storage.parquet import build_table, encode_parquet
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.dataset.randomize import TEXTURE_PX
from tableverse_factory.dataset.shards import TarShard
from tableverse_factory.evaluation.scene_audit import audit_scene
from tableverse_factory.geometry.math.camera import PosedCamera
from tableverse_factory.geometry.math.transforms import rotation_angle
from tableverse_factory.physics.mjcf.load import load_model
from tableverse_factory.physics.mjcf.scenery import load_scenery
from tableverse_factory.physics.render.domain_randomization import (
    CAMERA_SHIFT_M,
    CAMERA_TURN_RAD,
    LIGHT_STRENGTH,
    randomize_appearance,
)
from tableverse_factory.physics.render.views import RenderQuality, render_pictures
from tableverse_factory.sources.textures.catalogue import TILE_M, make_texture, parse_texture_seed
from tests.helpers.photographed_scene import box_and_ball

BOX = b'<mujoco><worldbody><body name="table"><geom type="box" size="%s"/></body></worldbody></mujoco>'


@pytest.fixture(scope="module", params=["photographed", "layout"])
def exported(request) -> ExportedScene:
    return box_and_ball(request.param == "photographed")


@pytest.fixture(scope="module")
def scene(exported) -> Scene:
    return Scene("scene", {}, dict(exported.files))


@pytest.fixture
def out(exported, tmp_path) -> Path:
    """A dataset of the one scene."""
    for folder in ("mjcf", *TABLES):
        (tmp_path / "out" / folder).mkdir(parents=True)
    with (tmp_path / "out/mjcf/shard-00000.tar").open("wb") as file:
        tar = TarShard(file)
        offset, size = tar.add(exported)
        tar.close()
    row = {**exported.scene_row, "status": "done", "shard": 0, "tar_offset": offset, "tar_size": size}
    rows = {"scenes": [row], "objects": exported.object_rows, "tasks": exported.task_rows}
    for name, schema in TABLES.items():
        (tmp_path / "out" / name / "shard-00000.parquet").write_bytes(
            encode_parquet(build_table(rows.get(name, []), schema))
        )
    return tmp_path / "out"


def table_picture(model):
    t = model.texture("table").id
    h, w, first = int(model.tex_height[t]), int(model.tex_width[t]), int(model.tex_adr[t])
    return model.tex_data[first : first + 3 * h * w].reshape(h, w, 3)


def test_the_exported_table_has_a_texture_in_the_colour_of_the_picture(scene):
    picture = table_picture(scene.model())
    assert np.abs(picture.mean(axis=(0, 1)) - [150, 120, 90]).max() < 6
    assert picture.std() > 0.5
    assert len(scene.files()["assets/table.png"]) < 120_000
    board = load_scenery(scene.model()).parts[-1]
    assert np.ptp(board.texture.corner_uv[..., 0]) * TILE_M == pytest.approx(np.ptp(board.vertices[:, 0]), rel=1e-5)


def test_a_texture_lies_on_the_table_and_nothing_else_changed(scene):
    before, after = scene.model(), scene.model(texture="marble-7")
    np.testing.assert_array_equal(table_picture(after), make_texture(parse_texture_seed("marble-7"), TEXTURE_PX))
    for name in (
        "body_mass",
        "body_inertia",
        "body_pos",
        "body_quat",
        "geom_size",
        "geom_friction",
        "mesh_vert",
        "qpos0",
    ):
        np.testing.assert_array_equal(getattr(before, name), getattr(after, name))
    assert before.opt.timestep == after.opt.timestep
    assert after.ntex == before.ntex


@pytest.mark.heavy
def test_it_is_the_same_each_time_and_the_scene_keeps_its_files(scene):
    files = scene.files()
    look = {"texture": 12, "lights": 3, "camera": 4}
    assert scene.restyle(**look).files() == scene.restyle(**look).files()
    assert scene.files() == files
    assert scene.restyle().files() == files
    others = [scene.restyle(**{**look, key: 99}).xml for key in ("lights", "camera")]
    assert len({scene.restyle(**look).xml, *others}) == 3


@pytest.mark.heavy
def test_a_restyled_scene_is_as_certified(scene):
    restyled = scene.restyle(texture=5, lights=1, camera=1)
    assert audit_scene("scene", restyled.files()).problems == ()
    assert restyled.meta["style"] == {"texture": "terrazzo-0", "lights": 1, "camera": 1}


def test_restyling_twice_leaves_one_table(scene):
    twice = scene.restyle(texture=1).restyle(texture=2)
    np.testing.assert_array_equal(table_picture(twice.model()), make_texture(2, TEXTURE_PX))


def test_a_picture_of_ones_own_is_taken_as_it_is(scene):
    picture = np.random.default_rng(0).integers(0, 255, (40, 60, 3), dtype=np.uint8)
    np.testing.assert_array_equal(table_picture(scene.model(texture=picture)), picture)


def test_the_lamp_stays_over_the_table_within_its_bounds(scene):
    first = scene.model()
    places = []
    for seed in range(25):
        model = scene.model(lights=seed)
        assert model.nlight == first.nlight
        lamp = model.light("key")
        towards = -lamp.dir / np.linalg.norm(lamp.dir)
        assert np.sin(np.deg2rad(34)) < towards[2] < np.sin(np.deg2rad(81))
        assert np.linalg.norm(lamp.pos) == pytest.approx(np.linalg.norm(first.light("key").pos), rel=0.25)
        share = lamp.diffuse / first.light("key").diffuse
        assert LIGHT_STRENGTH[0] * 0.87 < share.min()
        assert share.max() < LIGHT_STRENGTH[1] * 1.13
        places.append(lamp.pos.copy())
    assert np.ptp(np.array(places), axis=0).min() > 0.5


def test_the_camera_steps_aside_within_its_bounds_or_is_put_up(scene):
    before = scene.model()
    for seed in range(10):
        model = scene.model(camera=seed)
        assert model.ncam == 1
        eye = model.cam("observation")
        if before.ncam:
            old = before.cam("observation")
            assert np.abs(eye.pos - old.pos).max() <= CAMERA_SHIFT_M + 1e-9
            assert 0 < rotation_angle(eye.quat, old.quat) <= np.sqrt(3) * CAMERA_TURN_RAD * 1.01
        else:
            data = mujoco.MjData(model)
            mujoco.mj_forward(model, data)
            forward = -data.cam_xmat[0].reshape(3, 3)[:, 2]
            hit = data.cam_xpos[0] + forward * (-data.cam_xpos[0][2] / forward[2])
            assert np.linalg.norm(hit[:2] - data.body("table").xpos[:2]) < 0.1
            assert data.cam_xpos[0][1] < 0


@pytest.mark.parametrize(
    ("look", "words"),
    [
        ({"texture": "granit-1"}, "no texture"),
        ({"texture": -1}, "no texture"),
        ({"texture": np.zeros((4, 4), dtype=np.uint8)}, "shape"),
        ({"texture": np.zeros((4, 4, 3))}, "uint8"),
        ({"lights": -1}, "lights"),
        ({"camera": 1.5}, "camera"),
    ],
)
def test_what_cannot_be_is_said(scene, look, words):
    with pytest.raises(InputError, match=words):
        scene.model(**look)


@pytest.mark.parametrize(
    ("xml", "words"),
    [
        (b"<mujoco", "does not parse"),
        (b"<robot/>", "no MJCF"),
        (b"<mujoco/>", "no body 'table'"),
        (b'<!DOCTYPE x [<!ENTITY a "aaaa">]><mujoco/>', "entities"),
        (BOX % b"1 x 2", "numbers"),
        (BOX % b"1 nan 2", "finite"),
    ],
)  # fmt: skip
def test_somebody_elses_xml_is_refused_in_words(xml, words):
    for look in ({"texture": 1}, {"texture": 1, "camera": 1}):
        with pytest.raises(InputError, match=words):
            Scene("scene", {}, {"scene.xml": xml}).model(**look)


@pytest.mark.parametrize(
    ("extra", "words"),
    [
        ('<camera name="observation" pos="0 0"/>', "pos='0 0' of <camera>: 3 finite numbers"),
        ('<camera name="observation" quat="1 0 0"/>', "quat='1 0 0' of <camera>: 4 finite numbers"),
        ('<camera name="observation" quat="0 0 0 0"/>', "no rotation"),
        ('<camera name="observation" quat="1e-12 0 0 0"/>', "no rotation"),
        ('<camera name="observation" quat="1e200 0 0 0"/>', "no rotation"),
        ('<camera name="observation" fovy="1 2"/>', "fovy='1 2'"),
        ('<light diffuse="1 1"/>', "diffuse='1 1' of <light>"),
        ('<light pos="0 1"/>', "pos='0 1' of <light>"),
    ],
)
def test_cameras_and_lights_of_too_few_numbers_are_refused_in_words(extra, words):
    xml = (BOX % b"1 1 0.01").replace(b"<worldbody>", b"<worldbody>" + extra.encode())
    with pytest.raises(InputError, match=words) as caught:
        Scene("scene", {}, {"scene.xml": xml}).model(lights=1, camera=1)
    assert caught.value.reason == "bad_mjcf"


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-7"])
def test_entities_hide_in_no_encoding(encoding):
    bomb = f'<?xml version="1.0" encoding="{encoding}"?><!DOCTYPE m [<!ENTITY a "{"x" * 1000}">]>'
    bomb += f'<mujoco model="{"&a;" * 60}"><worldbody/></mujoco>'
    with pytest.raises(InputError) as caught:
        randomize_appearance({"scene.xml": bomb.encode(encoding)}, lights=1)
    assert caught.value.reason == "bad_mjcf"


def test_utf_8_stays_readable():
    name = "Täble – 卓"
    for start in (b"", b"\xef\xbb\xbf", b'<?xml version="1.0" encoding="utf-8"?>'):
        xml = start + f'<mujoco model="{name}"><!-- {name} --><worldbody/></mujoco>'.encode()
        assert name in randomize_appearance({"scene.xml": xml}, lights=1)["scene.xml"].decode()


def test_seeds_of_numpy_are_seeds(scene):
    look = {"texture": 3, "lights": 2, "camera": 1}
    assert scene.restyle(**{k: np.int64(v) for k, v in look.items()}).files() == scene.restyle(**look).files()
    np.testing.assert_array_equal(make_texture(np.uint8(7), 32), make_texture(7, 32))


@pytest.mark.heavy
def test_the_command_extracts_a_restyled_scene_that_verifies(scene, out, tmp_path):
    folder = tmp_path / "scene"
    arguments = ["extract", str(out), str(folder), "--scene", "scene", "--texture", "square_tiles-0", "--lights", "2"]
    assert CliRunner().invoke(app, arguments).exit_code == 0
    assert CliRunner().invoke(app, ["verify", str(folder)]).exit_code == 0
    assert mujoco.MjModel.from_xml_path(str(folder / "scene.xml")).ntex == scene.model().ntex
    assert json.loads((folder / "meta.json").read_text())["style"]["texture"] == "square_tiles-0"
    code = "import sys, tableverse_factory.dataset.dataset; assert not {'mujoco', 'PIL'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_our_own_pictures_repeat_the_tile_from_the_far_left_corner_as_mujoco_does(scene):
    tile_m, tile = 0.2, np.zeros((64, 64, 3), dtype=np.uint8)
    tile[:32, :32, 0] = tile[:32, 32:, 1] = tile[32:, :32, 2] = tile[32:, 32:, :2] = 250
    model = load_model(randomize_appearance(scene.files(), table_png=encode_png(tile), tile_m=tile_m))
    half, center = model.geom("table").size, model.body("table").pos
    above = Pose(np.array([center[0], center[1], 1.0]), np.array([0.0, 1.0, 0.0, 0.0]))
    eye = PosedCamera(Camera(200.0, 200.0, 150.0, 150.0, 301, 301), above)
    seen = render_pictures(load_scenery(model), [eye], RenderQuality(shadows=False))[0].color
    for x, y in ((0.04, 0.05), (0.15, 0.05), (0.05, 0.15), (0.16, 0.15), (0.24, 0.05), (0.55, 0.05), (0.05, 0.36)):
        column, row = round(150 + 200 * (x - half[0])), round(150 + 200 * (y - half[1]))
        wanted = tile[int(y / tile_m * 64) % 64, int(x / tile_m * 64) % 64]
        np.testing.assert_array_equal(seen[row, column] > 100, wanted > 100)
