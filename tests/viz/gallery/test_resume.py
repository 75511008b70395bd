"""A gallery goes on where it was stopped, draws only what is new, and has the same bytes as one drawn in one go."""

import json
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.viz.gallery.drawing import DrawingOptions
from tableverse_factory.viz.gallery.gallery import write_gallery
from tableverse_factory.viz.gallery.pages import Site
from tableverse_factory.viz.gallery.records import read_records
from tableverse_factory.viz.gallery.scene import SceneJob, write_scene
from tests.helpers.gallery_dataset import scene_members, write_dataset
from tests.helpers.recorded_dataset import two_scenes
from tests.viz.gallery.test_gallery import Page, digest, index_of

pytestmark = pytest.mark.heavy

MARKER = "tableverse-gallery.json"


def photographs(*names: str) -> dict[str, dict[str, bytes]]:
    return {name: scene_members(name, photographed=True) for name in names}


def written(folder: Path) -> dict[str, int]:
    """When each file was written [ns]."""
    return {
        path.relative_to(folder).as_posix(): path.stat().st_mtime_ns for path in folder.rglob("*") if path.is_file()
    }


def rewrite_dataset(out: Path, done: dict[str, dict[str, bytes]]) -> None:
    shutil.rmtree(out)
    write_dataset(out, done, [])


@pytest.mark.slow  # the test below stops it in the middle, and it goes on
@pytest.mark.usefixtures("full_quality")
def test_a_killed_report_goes_on(tmp_path):
    out = write_dataset(tmp_path / "out", photographs("a", "b", "c"), [])
    whole = write_gallery(open_dataset(out), tmp_path / "whole", jobs=1).parent
    site = tmp_path / "site"
    main = "from tableverse_factory.cli.main import main; main()"
    command = [sys.executable, "-c", main, "report", out, "--dest", site, "--jobs", "2"]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL) as process:
        while not len(list(site.glob("drawn/*.json"))) and process.poll() is None:
            time.sleep(0.01)
        process.kill()
    drawn = [path.stem for path in site.glob("drawn/*.json")]
    assert 0 < len(drawn) < 3
    assert re.search(r"Drawn so far: [0-2] of 3 scenes", Page(site / "index.html").text)
    before = written(site)
    write_gallery(open_dataset(out), site)
    assert digest(site) == digest(whole)
    kept = [name for name in before if any(name.startswith(f"pictures/{scene}-") for scene in drawn)]
    assert len(kept) >= 9 * len(drawn)
    assert {name: before[name] for name in kept}.items() <= written(site).items(), "drawn once"


def test_what_is_drawn_so_far_can_be_seen(tmp_path):
    out = write_dataset(tmp_path / "out", photographs("a", "b", "c"), [])
    site = tmp_path / "site"

    def stop(count: int, _all: int) -> None:
        if count == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_gallery(open_dataset(out), site, renders=0, progress=stop)
    index = Page(site / "index.html")
    assert "Drawn so far: 2 of 3 scenes" in index.text
    assert len(index.all("article")) == len(index_of(site)["done"]) == 2
    named = [each.get("src", each.get("href", "")) for each in index.all("img", "script", "link", "a")]
    assert all((site / name.partition("#")[0]).exists() for name in named if not name.startswith("data:"))
    assert not (site / "scenes" / "c.html").exists()
    write_gallery(open_dataset(out), site, renders=0)
    assert "Drawn so far" not in Page(site / "index.html").text


@pytest.mark.parametrize("renders", [*(pytest.param(n, marks=pytest.mark.slow) for n in (None, 1)), 0])
def test_a_second_report_draws_nothing(tmp_path, renders):
    source = two_scenes(tmp_path / "out")
    site = write_gallery(open_dataset(source), tmp_path / "site", renders=renders, films=1).parent
    bytes_before, before = digest(site), written(site)
    write_gallery(open_dataset(source), site, renders=renders, films=1)
    assert digest(site) == bytes_before
    assert {name for name, when in written(site).items() if when != before[name]} == {MARKER}


def test_only_new_and_changed_scenes_are_drawn_and_others_go(tmp_path):
    out = write_dataset(tmp_path / "out", photographs("a", "b", "gone"), [])
    site = write_gallery(open_dataset(out), tmp_path / "site", renders=0).parent
    before = written(site)
    changed = {**scene_members("b", photographed=True), "observation/color.jpg": b"no photograph"}
    rewrite_dataset(out, {**photographs("a"), "b": changed, **photographs("new")})
    write_gallery(open_dataset(out), site, renders=0)
    assert digest(site) == digest(write_gallery(open_dataset(out), tmp_path / "fresh", renders=0).parent)
    after = written(site)
    assert {name for name in after if before.get(name) == after[name] and name.startswith("pictures/")} == {
        "pictures/a-photo.jpg",
        "pictures/a-photo-s.jpg",
    }
    assert not [name for name in after if "gone" in name or "pictures/b" in name]


@pytest.mark.slow  # three galleries with all renders
def test_other_options_draw_what_they_change(tmp_path):
    out = write_dataset(tmp_path / "out", photographs("a", "b"), [])
    site = write_gallery(open_dataset(out), tmp_path / "site").parent
    before = written(site)
    write_gallery(open_dataset(out), site, renders=1)
    assert digest(site) == digest(write_gallery(open_dataset(out), tmp_path / "fresh", renders=1).parent)
    pictures = {name for name, when in written(site).items() if before.get(name) == when and "/a-" in name}
    assert len(pictures) == 9
    assert not (site / "pictures" / "b-twin.jpg").exists()


@pytest.mark.parametrize(
    "damage",
    ["no json", *(pytest.param(text, marks=pytest.mark.slow) for text in ("[]", "[" * 5000, '{"options": 3}')), None],
)
def test_a_drawing_that_is_damaged_or_lacks_a_picture_is_drawn_again(tmp_path, damage):
    out = write_dataset(tmp_path / "out", photographs("a"), [])
    site = write_gallery(open_dataset(out), tmp_path / "site", renders=0).parent
    before = digest(site)
    if damage is None:
        (site / "pictures" / "a-photo-s.jpg").unlink()
    else:
        (site / "drawn" / "a.json").write_text(damage)
    write_gallery(open_dataset(out), site, renders=0)
    assert digest(site) == before


def test_parts_of_files_that_a_kill_left_are_removed(tmp_path):
    out = write_dataset(tmp_path / "out", photographs("a"), [])
    site = tmp_path / "site"
    (site / "pictures").mkdir(parents=True)
    (site / f"{MARKER}.partial").write_text("{")
    write_gallery(open_dataset(out), site, renders=0)
    before = digest(site)
    for name in ("pictures/a-photo.jpg", "drawn/a.json", "index.html"):
        (site / f"{name}.partial").write_text("half")
    write_gallery(open_dataset(out), site, renders=0)
    assert digest(site) == before


def test_scenes_that_could_not_be_drawn_are_tried_again(tmp_path):
    out = write_dataset(tmp_path / "out", photographs("a"), [])
    tar = out / "mjcf" / "shard-00000.tar"
    whole = tar.read_bytes()
    tar.write_bytes(whole[:2000])
    site = write_gallery(open_dataset(out), tmp_path / "site", renders=0).parent
    assert "No pictures" in Page(site / "index.html").text
    tar.write_bytes(whole)
    write_gallery(open_dataset(out), site, renders=0)
    assert digest(site) == digest(write_gallery(open_dataset(out), tmp_path / "fresh", renders=0).parent)
    assert "No pictures" not in Page(site / "index.html").text


def test_a_disk_that_refuses_pictures_stops_the_gallery(tmp_path):
    out = write_dataset(tmp_path / "out", photographs("a"), [])
    site = Site(tmp_path, "out", str(out), 1, 0, 0)
    (tmp_path / "pictures").write_text("a file")
    job = SceneJob(read_records(open_dataset(out)).done[0], render=False, before="", after="", page=1)
    with pytest.raises(BuildError, match="cannot write"):
        write_scene(site, DrawingOptions(0, None, None, ""), job)


def test_the_marker_lists_every_file(tmp_path):
    out = write_dataset(tmp_path / "out", photographs("a"), [])
    site = write_gallery(open_dataset(out), tmp_path / "site", renders=0).parent
    listed = json.loads((site / MARKER).read_text())["files"]
    assert set(listed) == {name for name in written(site) if name != MARKER and not name.endswith(".lock")}
