"""Scenes with something wrong or missing in them: each costs its own pictures, and the gallery is told truly."""

import io
import json
import struct
import zlib
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from schemas.tables import TABLES
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.viz.gallery.drawing import DrawingOptions
from tableverse_factory.viz.gallery.gallery import write_gallery
from tableverse_factory.viz.gallery.pages import Site
from tableverse_factory.viz.gallery.pictures import write_pictures
from tableverse_factory.viz.gallery.records import SceneRecord
from tableverse_factory.viz.gallery.scene import SceneJob, write_scene
from tests.helpers.gallery_dataset import scene_members, write_dataset
from tests.viz.gallery.test_gallery import Page

pytestmark = pytest.mark.heavy

LIGHT = {"scene.xml": b"no xml", "meta.json": b"{}"}
KEYS = ("scene_id", "status", "shard", "tar_offset", "tar_size", "object_id", "task_id", "accepted")


def rewritten(out: Path, table: str, change) -> None:
    """The rows of a table, each as `change` leaves it."""
    path = out / table / "shard-00000.parquet"
    rows = pq.read_table(path).to_pylist()
    for row in rows:
        change(row)
    pq.write_table(pa.Table.from_pylist(rows, schema=TABLES[table]), path)


def text_of(page: Path) -> str:
    return " ".join(Page(page).text.split())


def jpeg(width: int, height: int) -> bytes:
    file = io.BytesIO()
    Image.new("RGB", (width, height), (120, 130, 140)).save(file, "JPEG")
    return file.getvalue()


def huge_png() -> bytes:
    head = b"IHDR" + struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + head + struct.pack(">I", zlib.crc32(head))


def test_a_bad_photograph_costs_one_scene_its_pictures(tmp_path):
    good = scene_members("scene", photographed=True)
    bad = {"huge": huge_png(), "strip": jpeg(4, 700), "cut": jpeg(640, 480)[:700], "empty": b""}
    done = {name: {**good, "observation/color.jpg": data} for name, data in bad.items()}
    out = write_dataset(tmp_path / "out", {"good": good, **done}, [])
    folder = write_gallery(open_dataset(out), tmp_path / "gallery", renders=0).parent
    assert {path.name for path in (folder / "pictures").iterdir()} == {"good-photo.jpg", "good-photo-s.jpg"}
    for name in bad:
        assert f"No pictures: scene {name}: its photograph " in text_of(folder / "scenes" / f"{name}.html")


def test_rows_that_say_nothing_are_shown_as_dashes(tmp_path):
    lost = [{"scene_id": "lost", "status": "failed"}]
    out = write_dataset(tmp_path / "out", {"scene": LIGHT}, lost)
    for table in TABLES:
        rewritten(out, table, lambda row: row.update({key: None for key in row if key not in KEYS}))
    rewritten(out, "tasks", lambda row: row.update(accepted=False))
    folder = write_gallery(open_dataset(out), tmp_path / "gallery").parent
    page = text_of(folder / "scenes" / "scene.html")
    assert "This scene has no certificate." in page
    assert "(no instruction) –" in page, "a refused task without its reason"
    assert "could not be shown" not in page
    assert "at rest" not in text_of(folder / "index.html")
    assert "1 without a certificate." in text_of(folder / "index.html")


def test_the_first_page_counts_the_scenes_that_are_sound(tmp_path):
    out = write_dataset(tmp_path / "out", dict.fromkeys(("a", "b", "c", "d"), LIGHT), [])
    differ = {"b": {"at_rest": False}, "c": {"colliding": True, "epsilon_m": 0.002}, "d": {"at_rest": None}}
    rewritten(out, "scenes", lambda row: row.update(differ.get(row["scene_id"], {})))
    folder = write_gallery(open_dataset(out), tmp_path / "gallery").parent
    said = "1 of 3 are at rest and free of collisions deeper than 2 mm. 1 without a certificate."
    assert said in text_of(folder / "index.html")
    verdicts = [Page(folder / "scenes" / f"{name}.html") for name in "abc"]
    assert ["verdict ok" in {tag.get("class") for tag in page.all("p")} for page in verdicts] == [True, False, False]


def test_numbers_that_are_none_and_half_characters_are_written_all_the_same(tmp_path):
    meta = {"assessment": {"reason_codes": ["half \ud800"], "criterion_scores": {}}, "left_out": []}
    members = {**scene_members("scene", photographed=False), "meta.json": json.dumps(meta).encode()}
    out = write_dataset(tmp_path / "out", {"scene": members}, [])
    numbers = {"drift_m": -np.inf, "mesh_penetration_m": np.nan, "piece_penetration_m": np.inf, "drift_rad": np.nan}
    rewritten(out, "scenes", lambda row: row.update(numbers))
    folder = write_gallery(open_dataset(out), tmp_path / "gallery", renders=0).parent
    assert r"half \ud800" in text_of(folder / "index.html")
    assert r"half \ud800" in text_of(folder / "scenes" / "scene.html")


def test_a_page_that_cannot_be_made_says_so_in_its_place(tmp_path):
    out = write_dataset(tmp_path / "out", {"scene": LIGHT}, [])
    row = open_dataset(out).scenes.to_table().drop_columns(["drift_m"]).to_pylist()[0]
    order = SceneJob(SceneRecord(row, (), (), ()), render=False, before="", after="", page=1)
    card = write_scene(Site(tmp_path, "out", str(out), 1, 0, 0), DrawingOptions(0, None, None, ""), order)
    assert "drift_m" in card.problem
    page = text_of(tmp_path / "scenes" / "scene.html")
    assert "This scene could not be shown: UndefinedError: " in page
    assert "tableverse view out scene" in page


@pytest.mark.parametrize("unseen", ["obj_000", pytest.param("obj_001", marks=pytest.mark.slow)])
def test_an_object_that_the_picture_did_not_show_is_not_in_the_view_before(tmp_path, unseen):
    """One of several alike, counted and not seen by itself: its scene keeps its pictures."""
    members = scene_members("alike", photographed=False)
    stand = {"position": [0.0, 0.0, 0.04], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
    objects = [
        {"object_id": name, "poses": {"placed": None if name == unseen else stand, "settled": stand}}
        for name in ("obj_000", "obj_001")
    ]
    meta = {**json.loads(members["meta.json"]), "objects": objects}
    out = write_dataset(tmp_path / "out", {"alike": {**members, "meta.json": json.dumps(meta).encode()}}, [])
    shown = write_pictures(open_dataset(out).scene("alike"), tmp_path, render=True)
    before, after = (
        np.asarray(Image.open(tmp_path / f"{name}.jpg")).astype(int) for name in (shown.before, shown.front)
    )
    red, green = ([(picture[..., k] > picture[..., 1 - k] + 60).sum() for picture in (before, after)] for k in (0, 1))
    gone, stays = (red, green) if unseen == "obj_000" else (green, red)
    assert gone[0] < 50 < 500 < gone[1]
    assert stays[0] > 500
