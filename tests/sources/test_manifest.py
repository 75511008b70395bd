"""The manifest: every entry found once, named by its content, and a row with a reason for each bad one."""

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from schemas.config import ObserveConfig
from schemas.identity import check_id
from schemas.manifest import ImageRow, SceneKind
from schemas.tables import MANIFEST
from tableverse_factory.core.errors import InputError
from tableverse_factory.sources.discovery import RECORDED
from tableverse_factory.sources.manifest import create_manifest, make_manifest, write_manifest
from tests.helpers.captures_on_disk import huge_png, write_capture, write_layout, write_picture

BOUNDS = ObserveConfig()


def rows_of(*paths, bounds=BOUNDS):
    return make_manifest([str(path) for path in paths], bounds).rows


def reasons(*paths):
    return {Path(row.uri).name: row.rejected for row in rows_of(*paths)}


def test_captures_layouts_and_pictures_are_found(tmp_path):
    write_capture(tmp_path / "kitchen" / "table 1", 1)
    write_layout(tmp_path / "layouts" / "breakfast.json")
    write_picture(tmp_path / "photo.jpg", 2)
    (tmp_path / "layouts" / "notes.json").write_text('{"a": 1}')
    (tmp_path / "readme.txt").write_text("hello")
    made = make_manifest([str(tmp_path)], BOUNDS)
    assert [(row.kind, row.name, row.rejected) for row in made.rows] == [
        (SceneKind.CAPTURE, "table 1", ""),
        (SceneKind.LAYOUT, "breakfast.json", ""),
        (SceneKind.IMAGE, "photo.jpg", ""),
    ]
    assert [row.scene_id.rpartition("-")[0] for row in made.rows] == ["table-1", "breakfast", "photo"]
    assert made.ignored == {"JSON that is no layout": 1, "mesh": 1, "other file": 1}


def test_depth_and_camera_beside_a_picture_are_counted_together(tmp_path):
    write_picture(tmp_path / "photo.jpg", 2)
    for name in ("photo.depth.npy", "photo.camera.json", "lone.depth.npy"):
        (tmp_path / name).write_text("{}")
    assert make_manifest([str(tmp_path)], BOUNDS).ignored == {RECORDED: 2, "other file": 1}


def test_only_sources_that_state_nothing_are_counted(tmp_path):
    for name in ("a.png", "b.png", "all/c.png", "all/d.png", "each/e.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        write_picture(tmp_path / name, ord(name[-5]))
    for name in ("a.source.json", "gone.source.json", "all/d.source.json", "all/source.json", "each/e.source.json"):
        (tmp_path / name).write_text(json.dumps({"licence": f"of {name}"}))
    made = make_manifest([str(tmp_path)], BOUNDS)
    assert {row.name: row.licence for row in made.rows} == {
        "a.png": "of a.source.json", "b.png": "", "c.png": "of all/source.json", "d.png": "of all/d.source.json",
        "e.png": "of each/e.source.json",
    }  # fmt: skip
    assert made.ignored == {"source.json": 1}
    (tmp_path / "each" / "source.json").write_text("{}")
    assert make_manifest([str(tmp_path)], BOUNDS).ignored == {"source.json": 2}, "every picture there has its own"


def test_what_lies_in_a_capture_or_beside_meshes_belongs_to_it(tmp_path):
    capture = write_capture(tmp_path / "c", 1)
    write_picture(capture / "seg.png", 2)
    write_picture(capture / "extra" / "view.png", 3)
    write_layout(capture / "truth.json")
    write_layout(tmp_path / "l" / "a.json")
    write_picture(tmp_path / "l" / "texture.png", 4)
    write_picture(tmp_path / "l" / "textures" / "wood.png", 5)
    made = make_manifest([str(tmp_path)], BOUNDS)
    assert [row.name for row in made.rows] == ["c", "a.json"]
    assert made.ignored["picture among meshes"] == 2


def test_pictures_of_other_formats_are_rows_that_say_what_to_give(tmp_path):
    for name in ("a.gif", "b.HEIC", "c.tiff", "d.avif"):
        (tmp_path / name).write_bytes(b"?")
    write_capture(tmp_path / "capture.gif", 1)
    write_picture(tmp_path / "capture.gif" / "film.gif", 1)
    rows = rows_of(tmp_path)
    assert {row.name: row.rejected for row in rows} == {
        **dict.fromkeys(("a.gif", "b.HEIC", "c.tiff", "d.avif"), "unsupported_format"),
        "capture.gif": "",
    }
    (named,) = rows_of(tmp_path / "a.gif")
    assert named in rows
    assert "give PNG, JPEG or WebP" in named.rejected_detail


@pytest.mark.parametrize(
    ("size", "reason"),
    [((1, 1), "picture_too_small"), ((15, 400), "picture_too_small"), ((100, 3000), "picture_too_narrow"),
     ((801, 100), "picture_too_narrow"), ((16, 16), ""), ((16, 128), "")],
)  # fmt: skip
def test_what_no_model_can_see_is_rejected_before_a_build(tmp_path, size, reason):
    write_picture(tmp_path / "a.png", 1, size)
    (row,) = rows_of(tmp_path)
    assert row.rejected == reason
    assert not reason or f"a.png is {size[1]} x {size[0]} pixels" in row.rejected_detail


@pytest.mark.parametrize("bound", [10_000, 178_000_000])
def test_an_enormous_picture_is_told_the_key_that_bounds_it(tmp_path, bound):
    (tmp_path / "a.png").write_bytes(huge_png(60_000, 60_000))
    (row,) = rows_of(tmp_path, bounds=ObserveConfig(max_pixels=bound))
    assert row.rejected == "picture_too_large"
    assert f"a.png has 3600000000 pixels; at most {bound} (observe.max_pixels)" in row.rejected_detail
    assert "bomb" not in row.rejected_detail


def test_ids_come_from_the_content_and_not_from_the_place(tmp_path, monkeypatch):
    write_capture(tmp_path / "a" / "mug", 1)
    shutil.copytree(tmp_path / "a", tmp_path / "b")
    (first,), (second,) = rows_of(tmp_path / "a"), rows_of(tmp_path / "b")
    assert first.scene_id == second.scene_id
    monkeypatch.chdir(tmp_path / "b")
    (relative,) = rows_of("mug")
    assert relative == second, "a manifest works from another folder"
    assert Path(relative.uri).is_absolute()


@pytest.mark.parametrize("file", ["color.png", "depth.png", "camera.json", "masks.png"])
def test_every_file_that_is_decoded_counts_for_the_id(tmp_path, file):
    write_capture(tmp_path / "a", 1)
    before = rows_of(tmp_path)[0]
    write_capture(tmp_path / "other", 2, np.full((24, 32), 801, np.uint16), fx=31.0)
    shutil.copy(tmp_path / "a" / "depth.png", tmp_path / "other" / "masks.png")
    shutil.copy(tmp_path / "other" / file, tmp_path / "a" / file)
    assert rows_of(tmp_path / "a")[0].scene_id != before.scene_id


def test_the_mesh_counts_for_the_id_of_a_layout(tmp_path):
    path = write_layout(tmp_path / "a.json")
    before = rows_of(path)[0].scene_id
    (tmp_path / "mug.obj").write_bytes((tmp_path / "mug.obj").read_bytes() + b"# other\n")
    assert rows_of(path)[0].scene_id != before


def test_rows_of_one_id_are_numbered_each_once(tmp_path):
    for k in range(40):
        write_picture(tmp_path / f"{k:02d}" / "a.png", seed=1)
    ids = [row.scene_id for row in rows_of(tmp_path)]
    assert ids[1:] == [f"{ids[0]}-{k}" for k in range(2, 41)]


def test_a_second_entry_of_the_same_content_is_a_duplicate(tmp_path):
    for name in ("a/mug", "b/mug", "c/other"):
        write_capture(tmp_path / name, 1)
    rows = rows_of(tmp_path)
    assert [row.rejected for row in rows] == ["", "duplicate_of", "duplicate_of"]
    assert rows[0].scene_id in rows[2].rejected_detail
    assert len({row.scene_id for row in rows}) == 3
    assert rows[1].scene_id == f"{rows[0].scene_id}-2"


def test_a_duplicate_with_another_licence_says_so(tmp_path):
    for name, licence in (("a", "CC0-1.0"), ("b", "CC-BY-ND-4.0")):
        write_capture(tmp_path / name, 1)
        (tmp_path / name / "source.json").write_text(json.dumps({"licence": licence}))
    detail = rows_of(tmp_path)[1].rejected_detail
    assert detail.endswith("which has the licence CC0-1.0, and this one CC-BY-ND-4.0")


def test_a_path_given_twice_is_one_row(tmp_path):
    write_capture(tmp_path / "a", 1)
    assert len(rows_of(tmp_path, tmp_path / "a", f"{tmp_path}/./a/")) == 1


def test_order_and_bytes_do_not_depend_on_the_order_of_creation(tmp_path):
    for root, order in (("x", (1, 2, 3)), ("y", (3, 1, 2))):
        for seed in order:
            write_capture(tmp_path / root / f"c{seed}", seed)
    left, right = ([row.model_copy(update={"uri": ""}) for row in rows_of(tmp_path / root)] for root in ("x", "y"))
    assert left == right
    for name in ("1", "2"):
        write_manifest(tmp_path / f"{name}.parquet", left)
    assert (tmp_path / "1.parquet").read_bytes() == (tmp_path / "2.parquet").read_bytes()


def test_a_folder_is_no_file_to_write(tmp_path):
    """It is said before anything is read."""
    with pytest.raises(InputError, match=r"is a folder: name the Parquet file to write, such as .*images\.parquet"):
        create_manifest([str(tmp_path / "nowhere")], str(tmp_path))


def test_rows_come_back_from_the_file(tmp_path):
    write_capture(tmp_path / "in" / "a", 1)
    rows = rows_of(tmp_path / "in")
    write_manifest(tmp_path / "m.parquet", rows)
    table = pq.read_table(tmp_path / "m.parquet")
    assert table.schema.equals(MANIFEST)
    assert tuple(ImageRow.model_validate(row) for row in table.to_pylist()) == rows


def with_files(folder, **files):
    for name, data in files.items():
        (folder / name.replace("__", ".")).write_bytes(data)
    return folder


def cut(path, share):
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])


HOSTILE_CAPTURES = {
    "unreadable_color": lambda c: cut(c / "color.png", 0.5),
    "unreadable_depth": lambda c: cut(c / "depth.png", 0.7),
    "depth_not_16_bit": lambda c: write_capture(c, 1, np.full((24, 32), 80, np.uint8)),
    "depth_size_differs": lambda c: write_capture(c, 1, np.full((12, 16), 800, np.uint16)),
    "depth_all_zero": lambda c: write_capture(c, 1, np.zeros((24, 32), np.uint16)),
    "bad_intrinsics": lambda c: write_capture(c, 1, fx=float("nan")),
    "picture_too_large": lambda c: with_files(c, color__png=huge_png(60_000, 60_000)),
    "missing_depth": lambda c: (c / "depth.png").unlink(),
    "missing_color": lambda c: (c / "color.png").unlink(),
    "missing_camera": lambda c: (c / "camera.json").unlink(),
    "bad_detections": lambda c: with_files(c, detections__json=b'{"detections": [{"label": 3}]}'),
    "bad_masks": lambda c: with_files(c, masks__png=b"no picture"),
    "bad_source": lambda c: with_files(c, source__json=b'{"licence": ["MIT"]}'),
}


@pytest.mark.parametrize("reason", HOSTILE_CAPTURES)
def test_a_hostile_capture_is_a_row_with_its_reason(tmp_path, reason):
    HOSTILE_CAPTURES[reason](write_capture(tmp_path / "bad", 1))
    write_capture(tmp_path / "good", 2)
    bad, good = rows_of(tmp_path)
    assert (bad.rejected, good.rejected) == (reason, "")
    assert bad.rejected_detail.isprintable()
    assert " at 0x" not in bad.rejected_detail, "an address in memory is another one in every run"


@pytest.mark.parametrize("focal", [0.82, 1e5])
def test_focal_lengths_that_are_no_pixels_are_told_so(tmp_path, focal):
    write_capture(tmp_path / "bad", 1, fx=focal, fy=focal)
    (row,) = rows_of(tmp_path)
    assert row.rejected == "bad_intrinsics"
    assert "give pixels, for 1° to 160°" in row.rejected_detail


HOSTILE_LAYOUTS = {
    "bad_layout": {"id": "../../x"},
    "bad_layout ": {"scale": -1},
    "bad_layout  ": {"pose": {"position": [0, 0, 1e99], "quaternion_wxyz": [1, 0, 0, 0]}},
    "bad_mesh": {"content": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"},
    "bad_mesh ": {"content": b""},
    "missing_mesh": {"content": None},
    "bad_mesh_path": {"mesh": "../../../etc/passwd"},
    "bad_mesh_path ": {"mesh": "/etc/passwd"},
    "bad_mesh_path  ": {"mesh": "http://localhost:1/mug.obj"},
}


@pytest.mark.parametrize("reason", HOSTILE_LAYOUTS)
def test_a_hostile_layout_is_a_row_with_its_reason(tmp_path, reason):
    write_layout(tmp_path / "bad.json", **HOSTILE_LAYOUTS[reason])
    assert reasons(tmp_path)["bad.json"] == reason.strip()


def test_a_damaged_picture_of_a_mesh_is_found_before_the_build(tmp_path):
    lines = ["mtllib a.mtl", "v 0 0 0", "v 1 0 0", "v 0 1 0", "vt 0 0", "usemtl m", "f 1/1 2/1 3/1"]
    write_layout(tmp_path / "bad.json", content="\n".join(lines).encode())
    folder = next(tmp_path.rglob("*.obj")).parent
    (folder / "a.mtl").write_text("newmtl m\nmap_Kd a.png\n")
    (folder / "a.png").write_bytes(b"no picture")
    assert reasons(tmp_path)["bad.json"] == "bad_texture"


def test_a_label_that_looks_like_markup_is_only_text(tmp_path):
    write_layout(tmp_path / "a.json", label='"/><x a="')
    assert reasons(tmp_path) == {"a.json": ""}


def test_a_broken_layout_is_still_known_as_one(tmp_path):
    write_layout(tmp_path / "a.json")
    for share in (0.9, 0.2, 0.05, 0.0):
        cut(tmp_path / "a.json", share)
        assert reasons(tmp_path) == {"a.json": "bad_layout"}, share


@pytest.mark.parametrize(("right", "wrong"), [('"objects"', '"object"'), ('"mesh"', '"msh"'), ('"pose"', '"pos"')])
def test_a_layout_with_a_misspelt_key_is_still_known_as_one(tmp_path, right, wrong):
    path = write_layout(tmp_path / "a.json")
    path.write_text(path.read_text().replace(right, wrong))
    (row,) = rows_of(tmp_path)
    assert (row.rejected, wrong.strip('"') in row.rejected_detail) == ("bad_layout", True)
    assert f"did you mean {right.strip(chr(34))}?" in row.rejected_detail


@pytest.mark.parametrize("name", ["camera.json", "detections.json", "truth.json", "source.json", "a.source.json"])
def test_what_a_capture_or_a_licence_is_kept_in_is_never_a_layout(tmp_path, name):
    write_picture(tmp_path / "b.png", 1)
    (tmp_path / name).write_text('{"objects": [{"mesh')
    found = make_manifest([str(tmp_path)], BOUNDS)
    assert [row.name for row in found.rows] == ["b.png"]
    assert sum(found.ignored.values()) == (name != "source.json"), "which is the picture's"


@pytest.mark.parametrize(("picture", "layouts"), [("table.jpg", 0), ("table.PNG", 0), ("other.png", 1)])
def test_a_broken_camera_beside_its_picture_is_no_layout(tmp_path, picture, layouts):
    write_picture(tmp_path / picture, 1)
    (tmp_path / "table.camera.json").write_text('{"fx": 5')
    assert sum(row.kind is SceneKind.LAYOUT for row in rows_of(tmp_path)) == layouts


def test_the_truth_beside_layouts_is_left_alone(tmp_path):
    write_layout(tmp_path / "a.json")
    pose = {"position": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0], "scale": 1.0}
    (tmp_path / "truth").mkdir()
    (tmp_path / "truth" / "a.json").write_text(json.dumps({"obj_000": pose}))
    made = make_manifest([str(tmp_path)], BOUNDS)
    assert [row.name for row in made.rows] == ["a.json"]
    assert made.ignored["JSON that is no layout"] == 1


def test_a_layout_without_objects_or_in_another_encoding_is_a_row(tmp_path):
    whole = write_layout(tmp_path / "a.json")
    whole.write_bytes(whole.read_text().encode("utf-16"))
    (tmp_path / "b.json").write_text('{"scene_id": "b", "objects": []}')
    (tmp_path / "c.json").write_text('{"scene_id": "c", "score": 1, "objects": []}')
    (tmp_path / "d.json").write_text('{"objects": [], "scene_id": "d"}')
    (tmp_path / "e.json").write_bytes(b"\xef\xbb\xbf" + b'{"scene_id": "e", "objects": []}')
    assert reasons(tmp_path) == {"a.json": "", **dict.fromkeys(("b.json", "d.json", "e.json"), "bad_layout")}


@pytest.mark.parametrize("content", [b"", b"GIF89a", b"\x89PNG\r\n\x1a\n", huge_png(60_000, 60_000), huge_png(0, 9)])
def test_a_picture_that_does_not_decode_is_a_row(tmp_path, content):
    (tmp_path / "a.png").write_bytes(content)
    (row,) = rows_of(tmp_path)
    assert row.rejected in ("unreadable_color", "picture_too_large")


def test_bounds_are_those_of_the_configuration(tmp_path):
    write_picture(tmp_path / "a.png", 1)
    assert rows_of(tmp_path, bounds=ObserveConfig(max_pixels=100))[0].rejected == "picture_too_large"
    assert rows_of(tmp_path, bounds=ObserveConfig(max_file_bytes=100))[0].rejected == "file_too_large"


@pytest.mark.parametrize(
    ("note", "licence", "detail"),
    [
        ('{"license": "MIT"}', "MIT", ""),
        ('{"Licence": "MIT"}', "", "b.source.json: 'Licence' is no key: did you mean licence?"),
        ('{"known_lenght": {}}', "", "b.source.json: 'known_lenght' is no key: did you mean known_length?"),
    ],
)
def test_a_misspelt_key_is_not_passed_over(tmp_path, note, licence, detail):
    write_picture(tmp_path / "b.png", 1)
    (tmp_path / "b.source.json").write_text(note)
    [row] = make_manifest([str(tmp_path)], ObserveConfig()).rows
    assert (row.licence, row.rejected_detail) == (licence, detail)


def test_source_and_licence_come_from_the_sidecar(tmp_path):
    note = '{"source": "https://example.org/1", "licence": "CC-BY-4.0", "more": 1}'
    (write_capture(tmp_path / "c", 1) / "source.json").write_text(note)
    write_picture(tmp_path / "p" / "a.png", 2)
    write_picture(tmp_path / "p" / "b.png", 3)
    (tmp_path / "p" / "source.json").write_text(note)
    (tmp_path / "p" / "b.source.json").write_text('{"licence": "MIT\\u001b[2J"}')
    rows = {row.name: row for row in rows_of(tmp_path)}
    assert (rows["c"].source, rows["c"].licence) == ("https://example.org/1", "CC-BY-4.0")
    assert rows["a.png"].licence == "CC-BY-4.0"
    assert (rows["b.png"].source, rows["b.png"].licence) == ("", "MIT\\x1b[2J")


@pytest.mark.parametrize(
    "note", [b"", b"[]", b'{"source": 1}', b'{"licence": null}', b'{"source": "' + b"x" * 3000 + b'"}', b"[" * 60_000]
)
def test_a_sidecar_that_cannot_be_read_is_not_taken_for_none(tmp_path, note):
    (write_capture(tmp_path / "c", 1) / "source.json").write_bytes(note)
    assert rows_of(tmp_path)[0].rejected == "bad_source"


HOSTILE_NAMES = [
    "a\nb",
    "\x1b[2J",
    "a::b",
    "~",
    "-rf",
    "a b",
    "'\"",
    "<x>",
    "\\",
    "%2e%2e",
    "é\u202e",
    "x" * 250,
]


@pytest.mark.parametrize("name", HOSTILE_NAMES, ids=range(len(HOSTILE_NAMES)))
def test_hostile_names_are_rows(tmp_path, name):
    write_capture(tmp_path / "in" / name, 1)
    (row,) = rows_of(tmp_path / "in")
    check_id(row.scene_id)
    assert row.name.isprintable()
    assert row.rejected == ("unsafe_name" if "::" in name else "")
    write_manifest(tmp_path / "m.parquet", [row])


def test_hidden_folders_are_counted_and_entered_when_named(tmp_path):
    write_capture(tmp_path / ".cache" / "c", 1)
    made = make_manifest([str(tmp_path)], BOUNDS)
    assert (made.rows, made.ignored) == ((), {"hidden folder": 1})
    assert len(rows_of(tmp_path / ".cache")) == 1


def test_a_name_that_is_no_utf8_is_a_row(tmp_path):
    target = os.fsencode(tmp_path) + b"/\xff\xfe.png"
    shutil.copy(os.fsencode(write_picture(tmp_path / "a.png", 1)), target)
    by_reason = {row.rejected: row for row in rows_of(tmp_path)}
    assert set(by_reason) == {"", "name_not_utf8"}
    write_manifest(tmp_path / "m.parquet", by_reason.values())


def test_a_path_longer_than_the_system_takes_is_a_row(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(25):  # 25 × 200 characters
        Path("d" * 200).mkdir()
        os.chdir("d" * 200)
    write_picture(Path("deep.png"), 1)
    os.chdir(tmp_path)
    (row,) = rows_of(tmp_path)
    assert row.rejected == "unreadable_folder"
    write_manifest(tmp_path / "m.parquet", [row])


def test_links_are_followed_once_and_loops_end(tmp_path):
    write_capture(tmp_path / "in" / "real", 1)
    write_capture(tmp_path / "elsewhere" / "far", 2)
    (tmp_path / "in" / "a_loop").symlink_to(tmp_path / "in")
    (tmp_path / "in" / "a_second_name").symlink_to(tmp_path / "in" / "real")
    (tmp_path / "in" / "link").symlink_to(tmp_path / "elsewhere")
    (tmp_path / "in" / "self").symlink_to(tmp_path / "in" / "self")
    (tmp_path / "in" / "dangling.png").symlink_to("nowhere.png")
    assert reasons(tmp_path / "in") == {"real": "", "far": "", "dangling.png": "unreadable_color"}


def test_a_pipe_does_not_block(tmp_path):
    capture = write_capture(tmp_path / "c", 1)
    (capture / "depth.png").unlink()
    os.mkfifo(capture / "depth.png")
    os.mkfifo(tmp_path / "photo.png")
    os.mkfifo(tmp_path / "layout.json")
    found = reasons(tmp_path)
    assert found["c"] == "missing_depth"
    assert found["photo.png"] == "unreadable_color"


@pytest.mark.parametrize("path", ["nowhere", "", "x" * 10_000, "\0", "a.txt", "nosuch://x/y", "file:///nowhere/at/all"])
def test_a_path_that_is_not_there_is_said(tmp_path, monkeypatch, path):
    monkeypatch.chdir(tmp_path)
    Path("a.txt").write_text("no picture")
    with pytest.raises(InputError) as caught:
        rows_of(path)
    assert str(caught.value).isprintable()


@pytest.mark.parametrize(
    "path",
    ["s3://key:hush@bucket/x", "s3://key:hush/more@bucket/x", "s3://bucket/x?sig=hush", "s3a://key:hush@bucket/x"],
)
def test_a_secret_in_an_address_is_refused_and_not_repeated(path):
    with pytest.raises(InputError, match=r"AWS_|give a path, or s3://bucket/prefix") as caught:
        rows_of(path)
    assert "hush" not in str(caught.value)


def test_uris_work_like_paths(tmp_path):
    write_capture(tmp_path / "in" / "c", 1)
    write_picture(tmp_path / "in" / "photo.png", 2)
    rows = rows_of(f"file://{tmp_path}/in")
    assert [row.rejected for row in rows] == ["", ""]
    assert [row.scene_id for row in rows] == [row.scene_id for row in rows_of(tmp_path / "in")]
    assert rows_of(f"file://{tmp_path}/in/photo.png")[0].scene_id == rows[1].scene_id


@settings(max_examples=40, deadline=None)
@given(
    st.text(min_size=1, max_size=60).filter(
        lambda t: "/" not in t and "\0" not in t and len(t.encode("utf-8", "replace")) < 200
    )
)
def test_any_name_gives_a_safe_unique_id(tmp_path_factory, name):
    root = tmp_path_factory.mktemp("any")
    try:
        write_picture(root / f"{name}.png", 1)
    except (OSError, UnicodeEncodeError, ValueError):
        return
    for row in rows_of(root):
        check_id(row.scene_id)
        assert row.name.isprintable()


@pytest.mark.heavy
@pytest.mark.shared
def test_the_real_captures_and_layouts_enter(shared_dir):
    rows = rows_of(shared_dir / "captures", shared_dir / "layouts")
    assert not [row for row in rows if row.rejected]
    kinds = [row.kind for row in rows]
    assert kinds.count(SceneKind.CAPTURE) == sum(path.is_dir() for path in (shared_dir / "captures").iterdir())
    assert kinds.count(SceneKind.LAYOUT) == 60
