"""Repositories of PBR maps: the sites' own names, licences only where something states them, hostile files as rows."""

import io
import json
import os

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image
from typer.testing import CliRunner

from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.sources.textures.conventions import MAPS, find_source, parse_category, parse_map_name
from tableverse_factory.sources.textures.library import open_library, write_index
from tableverse_factory.sources.textures.repository import index_textures
from tests.helpers.captures_on_disk import huge_png

AMBIENT = ("Color", "NormalGL", "NormalDX", "Roughness", "AmbientOcclusion", "Displacement", "Metalness")


def picture(size=(128, 128), color=(200, 100, 50), kind="JPEG"):
    out = io.BytesIO()
    Image.new("RGB", size, color).save(out, kind)
    return out.getvalue()


def put(root, name, data=None):
    path = root / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(picture() if data is None else data)
    return path


def rows(root, source=""):
    return {row["name"]: row for row in index_textures(root, source).to_pylist()}


@pytest.mark.parametrize(
    ("stem", "asset", "kind", "resolution"),
    [
        ("Wood001_1K-JPG_Color", "Wood001", "color", "1K"),
        ("Wood049A_2K-PNG_NormalGL", "Wood049A", "normal_gl", "2K"),
        ("PaintedMetal006_8K-JPG_AmbientOcclusion", "PaintedMetal006", "ambient_occlusion", "8K"),
        ("PavingStones036_4K_Roughness", "PavingStones036", "roughness", "4K"),
        ("PavingStones036_4K_nrm", "PavingStones036", "normal", "4K"),
        ("wood_12_basecolor-4K", "wood_12", "color", "4K"),
        ("wood_12_ambientocclusion-1K", "wood_12", "ambient_occlusion", "1K"),
        ("Wood 12 diffuseOriginal", "Wood 12", "color", ""),
        ("marble-white_height", "marble-white", "displacement", ""),
        ("rough_oak_rough", "rough_oak", "roughness", ""),
    ],
)
def test_names_say_what_they_are(stem, asset, kind, resolution):
    found = parse_map_name(stem)
    assert (found.asset, found.kind, found.resolution) == (asset, kind, resolution)


@pytest.mark.parametrize(
    "stem", ["Wood001", "Color", "_color", "", "Wood001_1K-JPG", "x" * 300 + "_Color", "painted_metal"]
)
def test_what_is_no_map_is_none(stem):
    assert parse_map_name(stem) is None


@given(st.text(max_size=60))
def test_no_name_breaks_it(stem):
    found = parse_map_name(stem)
    assert found is None or (found.kind in MAPS and found.asset)
    assert isinstance(parse_category(stem), str)


def test_categories_and_sources_are_words():
    assert parse_category("WoodFloor012") == "wood floor"
    assert parse_category("wood_12") == "wood"
    assert parse_category("007") == ""
    assert find_source("ambientCG") == "ambientcg"
    assert find_source("CC0_Textures") == "cc0-textures"
    assert find_source("Share Textures") == "sharetextures"
    assert find_source("my photos") == ""


@pytest.mark.parametrize(
    "folder",
    ["not-ambientCG-paid", "poliigon_vs_ambientcg_edit", "fakesharetextures", "не ambientCG", "ambientCG!", ""],
)
def test_a_folder_that_only_mentions_a_source_has_none(folder, tmp_path):
    assert find_source(folder) == ""
    put(tmp_path, f"{folder or 'maps'}/Wood001_1K-JPG_Color.jpg")
    assert rows(tmp_path)["Wood001"]["licence"] is None


def test_a_repository_becomes_rows_with_maps_category_and_licence(tmp_path):
    for kind in AMBIENT:
        put(tmp_path, f"ambientcg/Wood001/Wood001_1K-JPG_{kind}.jpg")
    put(tmp_path, "ambientcg/Wood001/Wood001.png", picture(kind="PNG"))
    put(tmp_path, "sharetextures/marble-3/marble_3_basecolor-1K.png", picture((256, 128), kind="PNG"))
    put(tmp_path, "sharetextures/marble-3/marble_3_height-1K.png", picture((128, 64), kind="PNG"))
    found = rows(tmp_path)
    wood, marble = found["Wood001"], found["marble_3"]
    assert (wood["category"], wood["source"], wood["licence"], wood["resolution"]) == (
        "wood",
        "ambientcg",
        "CC0-1.0",
        "1K",
    )
    assert wood["color"] == "ambientcg/Wood001/Wood001_1K-JPG_Color.jpg"
    assert wood["normal_dx"]
    assert wood["opacity"] is None
    assert wood["mean_rgb"] == pytest.approx([200, 100, 50], abs=2)
    assert (marble["source"], marble["width"], marble["height"]) == ("sharetextures", 256, 128)
    assert len(found) == 2
    assert not any(row["rejected"] for row in found.values())


def test_two_resolutions_are_two_sets(tmp_path):
    put(tmp_path, "Wood001_1K-JPG_Color.jpg")
    put(tmp_path, "Wood001_2K-JPG_Color.jpg")
    table = index_textures(tmp_path)
    assert sorted(table["resolution"].to_pylist()) == ["1K", "2K"]
    assert len(set(table["texture_id"].to_pylist())) == 2


def test_a_licence_is_what_something_states_and_nothing_else(tmp_path):
    put(tmp_path, "own/Wood001_1K-JPG_Color.jpg")
    assert rows(tmp_path)["Wood001"]["licence"] is None, "a name in a site's fashion licenses nothing"
    assert rows(tmp_path, "cc0-textures")["Wood001"]["licence"] == "CC0-1.0"
    assert rows(tmp_path, "my friend")["Wood001"]["licence"] is None
    put(tmp_path, "source.json", json.dumps({"source": "a shop", "licence": "CC-BY-4.0"}).encode())
    assert rows(tmp_path, "cc0-textures")["Wood001"]["licence"] == "CC-BY-4.0"
    put(tmp_path, "own/source.json", b"[" * 100_000)
    assert rows(tmp_path)["Wood001"]["licence"] is None
    put(tmp_path, "own/source.json", json.dumps({"source": 7, "licence": "x\x1b" * 999}).encode())
    row = rows(tmp_path)["Wood001"]
    assert row["source"] is None
    assert row["licence"].isprintable()
    assert len(row["licence"]) <= 200


@pytest.mark.heavy
@pytest.mark.parametrize(
    ("files", "reason"),
    [
        ({"A1_1K_Roughness.jpg": None}, "no_color_map"),
        ({"A1_1K_Color.jpg": b"no picture"}, "unreadable_map"),
        ({"A1_1K_Color.jpg": b""}, "unreadable_map"),
        ({"A1_1K_Color.jpg": picture()[:300]}, "unreadable_map"),
        ({"A1_1K_Color.jpg": picture((8, 8))}, "picture_too_small"),
        ({"A1_1K_Color.jpg": None, "A1_1K_Normal.jpg": picture((128, 64))}, "shapes_differ"),
        ({"A1_1K_Color.jpg": None, "A1_1K_Color.png": picture(kind="PNG")}, "ambiguous_maps"),
        ({"A1_1K_Color.jpg": None, "A1_1K_Normal.jpg": b"\x00" * 50}, "unreadable_map"),
        ({"A1_1K_Color.png": b"BOMB"}, "picture_too_large"),
    ],
)
def test_a_bad_set_is_a_row_with_its_reason(tmp_path, files, reason):
    for name, data in files.items():
        put(tmp_path, name, huge_png(20_000, 20_000) if data == b"BOMB" else data)
    row = rows(tmp_path)["A1"]
    assert row["rejected"] == reason
    assert row["rejected_detail"].isprintable()
    assert row["width"] is None


def test_links_pipes_and_depths_lead_nowhere(tmp_path):
    root = tmp_path / "root"
    put(root, "Wood001_1K-JPG_Color.jpg")
    outside = put(tmp_path, "outside/Stone001_1K-JPG_Color.jpg")
    (root / "Stone001_1K-JPG_Color.jpg").symlink_to(outside)
    (root / "loop").symlink_to(root)
    os.mkfifo(root / "Pipe001_1K-JPG_Color.jpg")
    put(root, "/".join("abcdefghijkl") + "/Deep001_1K-JPG_Color.jpg")
    put(root, ".hidden/Hidden001_1K-JPG_Color.jpg")
    put(root, "Evil\x1b[2J001_1K-JPG_Color.jpg")
    assert list(rows(root)) == ["Wood001"]
    with pytest.raises(InputError, match="no such folder"):
        index_textures(root / "nowhere")


def test_the_index_is_the_same_each_time_and_gives_pictures_back(tmp_path):
    put(tmp_path, "maps/Wood001_1K-JPG_Color.jpg")
    put(tmp_path, "maps/Wood002_1K-JPG_Color.jpg", picture((512, 256), (10, 200, 30)))
    put(tmp_path, "maps/Wood003_1K-JPG_Color.jpg", b"broken")
    write_index(tmp_path / "a.parquet", index_textures(tmp_path / "maps"))
    write_index(tmp_path / "b.parquet", index_textures(tmp_path / "maps"))
    assert (tmp_path / "a.parquet").read_bytes() == (tmp_path / "b.parquet").read_bytes()
    library = open_library(tmp_path / "a.parquet")
    assert len(library) == 2
    np.testing.assert_allclose(library.read_picture("Wood002", 128).mean(axis=(0, 1)), [10, 200, 30], atol=3)
    assert library.read_picture(1, 128).shape == (64, 128, 3)
    assert library.read_picture(3).shape == (256, 512, 3), "seeds go round"
    with pytest.raises(InputError, match="no texture"):
        library.read_picture("Wood003")
    with pytest.raises(InputError, match="cannot be read"):
        open_library(tmp_path / "a.parquet", tmp_path / "elsewhere").read_picture(0)


def test_an_index_that_somebody_forged_opens_nothing_else(tmp_path):
    put(tmp_path, "secret.jpg")
    put(tmp_path, "maps/Wood001_1K-JPG_Color.jpg")
    table = index_textures(tmp_path / "maps")
    forged = table.set_column(table.schema.get_field_index("color"), "color", pa.array(["../secret.jpg"]))
    write_index(tmp_path / "forged.parquet", forged)
    with pytest.raises(InputError, match="outside"):
        open_library(tmp_path / "forged.parquet").read_picture(0)
    pq.write_table(pa.table({"a": [1]}), tmp_path / "other.parquet")
    for name in ("other.parquet", "secret.jpg", "nowhere.parquet"):
        with pytest.raises(InputError):
            open_library(tmp_path / name)


def test_the_commands(tmp_path):
    run = CliRunner().invoke
    put(tmp_path, "ambientcg/Wood001_1K-JPG_Color.jpg")
    put(tmp_path, "ambientcg/Wood002_1K-JPG_Normal.jpg")
    answer = run(app, ["textures", "index", str(tmp_path), "--out", str(tmp_path / "t.parquet"), "--json"])
    assert answer.exit_code == 0
    assert json.loads(answer.stdout) == {"usable": 1, "counts": {"licence CC0-1.0": 1, "rejected: no_color_map": 1}}
    answer = run(app, ["textures", "make", "marble-12", "--out", str(tmp_path / "m.png"), "--size", "64"])
    assert answer.exit_code == 0
    assert Image.open(tmp_path / "m.png").size == (64, 64)
    (tmp_path / "empty").mkdir()
    assert run(app, ["textures", "index", str(tmp_path / "empty"), "--out", "x"]).exit_code == 1
