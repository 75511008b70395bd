"""How much of a gallery is drawn, what it costs, and what stands on the pages of scenes that are not drawn."""

import json
import math
import os
from functools import partial

import numpy as np
import pytest
from PIL import Image

from tableverse_factory.core.errors import InputError
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.viz.gallery.gallery import (
    DRAW_ALL_LIMIT,
    FILMS_PER_SCENE,
    SAMPLE_SIZE,
    choose_amounts,
    write_gallery,
)
from tableverse_factory.viz.gallery.pictures import write_pictures
from tests.helpers.gallery_dataset import scene_members, write_dataset
from tests.helpers.recorded_dataset import two_scenes
from tests.viz.gallery.test_gallery import Page, digest, index_of

pytestmark = pytest.mark.heavy


def test_few_scenes_are_all_drawn_and_many_by_sample():
    assert choose_amounts(DRAW_ALL_LIMIT) == (DRAW_ALL_LIMIT, FILMS_PER_SCENE)
    assert choose_amounts(DRAW_ALL_LIMIT + 1) == (SAMPLE_SIZE, 0)
    assert choose_amounts(20_000, renders=300) == (300, 0)
    assert choose_amounts(3, films=0) == (3, 0)
    assert choose_amounts(3, renders=0, films=2) == (0, 2)


def test_scenes_that_are_not_drawn_have_picture_page_and_the_command_that_draws_them(tmp_path):
    done = {name: scene_members(name, photographed=name != "c-layout") for name in ("a-photo", "b-photo", "c-layout")}
    out = write_dataset(tmp_path / "my out", done, [])
    folder = write_gallery(open_dataset(out), tmp_path / "gallery", renders=1).parent
    names = {path.name for path in (folder / "pictures").iterdir()}
    assert {"a-photo-twin.jpg", "a-photo-front.jpg", "b-photo-photo.jpg", "c-layout-sketch-s.jpg"} <= names
    assert not names & {"b-photo-twin.jpg", "c-layout-front.jpg"}
    text = " ".join(Page(folder / "scenes" / "b-photo.html").text.split())
    assert "tableverse report 'my out' --renders 3" in text
    assert "tableverse view 'my out' b-photo" in text
    assert "This gallery draws" not in Page(folder / "scenes" / "a-photo.html").text
    shown = [image["src"] for image in Page(folder / "index.html").all("img")]
    assert shown == [f"pictures/{name}-s.jpg" for name in ("a-photo-photo", "b-photo-photo", "c-layout-sketch")]
    assert [entry[-2] for entry in index_of(folder)["done"]] == [["photograph", "twin"], ["photograph"], ["sketch"]]
    sketch = np.asarray(Image.open(folder / "pictures" / "c-layout-sketch-s.jpg")).astype(int)
    assert (sketch[..., 0] > sketch[..., 1] + 60).sum() > 500, "the red box"


def test_before_is_where_the_picture_put_things(tmp_path):
    members = scene_members("moved", photographed=False)
    here, there = ([0.0, 0.0, 0.04], [-0.1, 0.0, 0.04])
    poses = {"placed": there, "settled": here}
    poses = {key: {"position": value, "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]} for key, value in poses.items()}
    meta = {**json.loads(members["meta.json"]), "objects": [{"object_id": "obj_000", "poses": poses}]}
    out = write_dataset(tmp_path / "out", {"moved": {**members, "meta.json": json.dumps(meta).encode()}}, [])
    shown = write_pictures(open_dataset(out).scene("moved"), tmp_path, render=True)
    before, after = (
        np.asarray(Image.open(tmp_path / f"{name}.jpg")).astype(int) for name in (shown.before, shown.front)
    )
    reds, greens = ([picture[..., k] > picture[..., 1 - k] + 60 for picture in (before, after)] for k in (0, 1))
    middle = [np.nonzero(red)[1].mean() for red in reds]
    assert middle[0] < middle[1] - 40, "further left by 10 cm"
    assert np.abs(greens[0].sum() - greens[1].sum()) < 0.02 * greens[1].sum(), "what was not moved stands still"


@pytest.mark.parametrize(
    "pose", [{"position": [0, 0], "quaternion_wxyz": [1, 0, 0, 0]}, pytest.param(3, marks=pytest.mark.slow)]
)
def test_a_pose_that_is_none_costs_the_pictures_and_says_so(tmp_path, pose):
    members = scene_members("odd", photographed=False)
    item = {"object_id": "obj_000", "poses": {"placed": pose, "settled": pose}}
    meta = {**json.loads(members["meta.json"]), "objects": [item]}
    out = write_dataset(tmp_path / "out", {"odd": {**members, "meta.json": json.dumps(meta).encode()}}, [])
    page = write_gallery(open_dataset(out), tmp_path / "gallery").parent / "scenes" / "odd.html"
    assert "No pictures: meta.json: a pose of obj_000 makes no sense" in Page(page).text


def test_work_is_dealt_out_in_order_and_a_death_is_told():
    assert list(parallel_map(math.sqrt, [4.0, 9.0], 1, "counts")) == [2.0, 3.0]
    assert list(parallel_map(math.sqrt, [4.0, 9.0, 16.0], 2, "counts", chunk=2)) == [2.0, 3.0, 4.0]
    with pytest.raises(InputError, match="a process that counts died"):
        list(parallel_map(partial(os._exit), [3, 3], 2, "counts"))


def test_the_same_dataset_gives_the_same_bytes(tmp_path):
    source = two_scenes(tmp_path / "source")
    twice = [write_gallery(open_dataset(source), tmp_path / name, renders=0).parent for name in "ab"]
    assert digest(twice[0]) == digest(twice[1])
