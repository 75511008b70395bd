"""Folders of scenes: ours as extracted, somebody else's as released, each scene verified or named with its reason."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tableverse_factory.cli.main import app
from tableverse_factory.delivery.formats.extract import extract_scene
from tableverse_factory.delivery.formats.folders import find_scene_file, list_scene_folders
from tests.helpers.exported_scenes import exported

CUBE = (
    '<mujoco><worldbody><geom type="plane" size="1 1 1"/><body name="cube" pos="0 0 {z}"><freejoint/>'
    '<geom type="box" size="0.03 0.03 0.03"/></body></worldbody></mujoco>'
)


def release(folder: Path, name: str, text: str) -> None:
    home = folder / name
    (home / "assets").mkdir(parents=True)
    (home / f"{name}.xml").write_text(text)
    (home / "scene.glb").write_bytes(b"glTF")


def verified(path: Path) -> tuple[int, dict[str, dict]]:
    result = CliRunner().invoke(app, ["verify", str(path), "--json"])
    return result.exit_code, {scene["scene_id"]: scene for scene in json.loads(result.stdout)["scenes"]}


def test_a_folder_of_extracted_and_released_scenes_is_verified(tmp_path):
    extract_scene(exported(), tmp_path / "ours")
    release(tmp_path, "theirs", CUBE.format(z=0.0299))
    code, scenes = verified(tmp_path)
    assert code == 0
    assert set(scenes) == {"ours", "theirs"}
    assert scenes["ours"]["at_rest"] is True


def test_what_is_bad_is_named_and_the_others_are_measured_all_the_same(tmp_path):
    release(tmp_path, "floating", CUBE.format(z=0.5))
    release(tmp_path, "broken", "<mujoco><worldbody>")
    release(tmp_path, "good", CUBE.format(z=0.0299))
    code, scenes = verified(tmp_path)
    assert code == 1
    assert {name: scene["ok"] for name, scene in scenes.items()} == {"broken": False, "floating": False, "good": True}
    assert "does not load it" in scenes["broken"]["problems"][0]


def test_a_released_folder_alone_is_one_scene(tmp_path):
    release(tmp_path, "good", CUBE.format(z=0.0299))
    code, scenes = verified(tmp_path / "good")
    assert (code, list(scenes)) == (0, ["good"])


@pytest.mark.parametrize(
    ("files", "found"),
    [
        (["scene.xml", "other.xml"], "scene.xml"),
        (["kitchen.xml", "scene.glb"], "kitchen.xml"),
        (["a.xml", "b.xml", "scene.glb"], "scene.glb"),
        (["notes.xml"], None),
        (["scene.glb"], "scene.glb"),
        ([], None),
    ],
)
def test_which_file_is_the_scene(files, found, tmp_path):
    home = tmp_path / "home"
    home.mkdir()
    for name in files:
        (home / name).touch()
    assert find_scene_file(home) == (None if found is None else home / found)
    assert list_scene_folders(tmp_path) == ([] if found is None else [("home", home / found)])
