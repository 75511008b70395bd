"""Files of scenes that somebody else wrote: errors in words, whatever they hold."""

import json

import pytest

from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.randomize import randomize_files
from tableverse_factory.dataset.scene import Scene
from tableverse_factory.dataset.scene_meta import read_meta, read_meta_camera, read_object_names, read_object_phrases
from tableverse_factory.dataset.splits import get_split
from tableverse_factory.delivery.episodes.cameras import load_scene_camera

POSE = {"position": [0.0, -0.5, 0.5], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
XML = b"<mujoco><asset/><worldbody/></mujoco>"
CAMERA = {"fx": 500.0, "fy": 500.0, "cx": 319.5, "cy": 239.5, "width": 640, "height": 480}


def test_a_deeply_nested_meta_is_refused_in_words():
    with pytest.raises(InputError, match=r"meta\.json"):
        read_meta(b"[" * 200_000)


def test_a_deeply_nested_meta_does_not_stop_a_restyling():
    with pytest.raises(InputError, match=r"meta\.json"):
        randomize_files({"scene.xml": XML, "meta.json": b"[" * 200_000}, None, None, None)


def test_names_are_the_judges_else_the_detectors_whatever_else_is_there():
    objects = [{"object_id": "a", "label": "object"}, {"object_id": "b", "label": "mug\x1b"}, {"object_id": "c"}]
    assert list(read_object_names({"objects": objects}).values()) == ["object", "mug\\x1b", ""]
    for strange in (None, [], {"objects": None}, {"objects": [3, {"relabel_name": "x"}]}):
        assert read_object_names({"objects": objects, "assessment": strange})["a"] == "object"
    told = [{"object_id": "a", "relabel_name": "red box", "distinguishing_phrases": ["the largest box"]}]
    told.append({"object_id": "b", "relabel_name": "cup", "distinguishing_phrases": []})
    meta = {"objects": objects, "assessment": {"objects": told}}
    assert read_object_names(meta) == {"a": "red box", "b": "cup", "c": ""}
    assert read_object_phrases(meta) == {"a": "the largest box", "b": "the cup", "c": "the object"}


@pytest.mark.parametrize(
    "wrong",
    [{"width": float("inf")}, {"fx": float("nan")}, {"fy": -1.0}, {"cx": 1e400}, {"height": 0}, {"fx": "wide"}],
)
def test_a_camera_that_cannot_be_is_refused_by_all_who_read_it(wrong):
    meta = {"camera": {**CAMERA, **wrong}, "camera_to_table": POSE}
    meta = json.loads(json.dumps(meta))
    for read in (read_meta_camera, lambda given: load_scene_camera(given, 320, 240)):
        with pytest.raises(InputError, match="camera"):
            read(meta)


def test_a_camera_is_cropped_to_the_middle_of_the_picture():
    eye = load_scene_camera({"camera": CAMERA, "camera_to_table": POSE}, 240, 240)
    assert (eye.camera.width, eye.camera.height, eye.camera.fx) == (240, 240, 250.0)
    assert (eye.camera.cx, eye.camera.cy) == (119.5, 119.5)


def test_xml_that_is_no_text_is_refused_in_words():
    with pytest.raises(InputError, match=r"scene\.xml is not UTF-8"):
        _ = Scene("a-1", {}, {"scene.xml": b"<mujoco>\xff"}).xml


def test_a_split_of_another_name_is_refused_with_those_that_there_are():
    assert get_split({"scene_id": "a-1", "split": "validation"}) == "validation"
    with pytest.raises(InputError, match="'val' is none of train, validation, test"):
        get_split({"scene_id": "a-1", "split": "val"})
