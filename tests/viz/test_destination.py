"""Where a gallery is written: into nothing but a gallery of the dataset, and nobody loses anything."""

import os
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.viz.destination import (
    check_gallery,
    choose_destination,
    find_local_folder,
    lock_gallery,
)
from tableverse_factory.viz.gallery.gallery import write_gallery
from tableverse_factory.viz.gallery.pages import Site
from tableverse_factory.viz.gallery.scene import list_commands
from tests.helpers.gallery_dataset import scene_members, write_dataset
from tests.viz.gallery.test_gallery import digest

NO_SCENE = {"scene.xml": b"", "meta.json": b"{}"}


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("data") / "out", {"scene": NO_SCENE}, [])


def test_only_a_gallery_is_ever_written_into(out, tmp_path):
    mine = tmp_path / "mine"
    mine.mkdir()
    (mine / "thesis.txt").write_text("years")
    for dest in (mine, out, out / "report", mine / "thesis.txt"):
        with pytest.raises(InputError):
            write_gallery(open_dataset(out), dest)
    assert (mine / "thesis.txt").read_text() == "years"
    assert choose_destination(str(out), "gallery") == out.with_name("out-gallery")
    assert choose_destination("s3://bucket/a/out/", "gallery") == Path("out-gallery")


@pytest.mark.parametrize("form", ["{}", "file://{}", "{}/../out"])
def test_a_dataset_within_the_gallery_is_not_deleted_with_it(out, tmp_path, form):
    site = write_gallery(open_dataset(out), tmp_path / "site").parent
    inside = Path(shutil.copytree(out, site / "out"))
    before = digest(site)
    result = CliRunner().invoke(app, ["report", form.format(inside), "--dest", str(site)])
    assert result.exit_code != 0
    assert "holds the dataset" in str(result.exception)
    assert digest(site) == before


@pytest.mark.parametrize("name", ["notes.txt", "scenes/notes.txt", "mine/", "pictures/link"])
def test_what_people_put_into_a_gallery_is_kept(out, tmp_path, name):
    site = write_gallery(open_dataset(out), tmp_path / "site").parent
    if name.endswith("/"):
        (site / name).mkdir()
    elif name.endswith("link"):
        (site / name).symlink_to(out)
    else:
        (site / name).write_text("years")
    with pytest.raises(InputError, match=f"holds '{name}', no part of the gallery"):
        write_gallery(open_dataset(out), site)
    assert os.path.lexists(site / name)
    assert (site / "index.html").is_file()
    assert list(tmp_path.iterdir()) == [site]


def test_what_somebody_puts_there_meanwhile_is_kept_too(out, tmp_path):
    site = write_gallery(open_dataset(out), tmp_path / "site").parent
    dataset = open_dataset(out)

    def meanwhile(_drawn: int, _all: int) -> None:
        (site / "notes.txt").write_text("years")

    with pytest.raises(InputError, match=r"holds 'notes.txt'"):
        write_gallery(dataset, site, progress=meanwhile)
    assert (site / "notes.txt").read_text() == "years"
    assert (site / "index.html").is_file()


def test_the_gallery_of_another_dataset_is_kept(out, tmp_path):
    site = write_gallery(open_dataset(out), tmp_path / "site").parent
    before = digest(site)
    other = write_dataset(tmp_path / "other", {"scene": NO_SCENE}, [])
    with pytest.raises(InputError, match="the gallery of another dataset, out"):
        write_gallery(open_dataset(other), site)
    assert digest(site) == before


def test_two_reports_do_not_write_one_gallery(out, tmp_path):
    with (
        lock_gallery(tmp_path / "site", "out", "site"),
        pytest.raises(InputError, match="another `tableverse report` writes this gallery"),
    ):
        write_gallery(open_dataset(out), tmp_path / "site")
    write_gallery(open_dataset(out), tmp_path / "site")


def test_a_gallery_stays_the_same_also_through_a_link(out, tmp_path):
    site = write_gallery(open_dataset(out), tmp_path / "site").parent
    before = digest(site)
    (tmp_path / "latest").symlink_to(site)
    index = write_gallery(open_dataset(out), tmp_path / "latest")
    assert index == tmp_path / "latest" / "index.html"
    assert (tmp_path / "latest").readlink() == site
    assert digest(site) == before
    (tmp_path / "round").symlink_to(tmp_path / "round")
    with pytest.raises(InputError, match="leads nowhere"):
        write_gallery(open_dataset(out), tmp_path / "round")


@pytest.mark.parametrize("mark", ["", "[]", "{}", '{"files": 3, "folders": []}', "[" * 5000])
def test_a_mark_that_lists_nothing_licenses_nothing(tmp_path, mark):
    (tmp_path / "tableverse-gallery.json").write_text(mark)
    (tmp_path / "thesis.txt").write_text("years")
    with pytest.raises(InputError, match="does not list its files"):
        check_gallery(tmp_path, "out", "here")


@pytest.mark.heavy
def test_how_the_dataset_was_named_does_not_show(out, tmp_path, monkeypatch):
    """Neither as typed nor as it lies on the builder's machine, in the pages or in what is wrong with a scene."""
    source = write_dataset(tmp_path / "out", {"a": scene_members("a", photographed=False), "b": NO_SCENE}, [])
    tar = source / "mjcf" / "shard-00000.tar"
    tar.write_bytes(tar.read_bytes()[:2000])
    monkeypatch.chdir(source)
    named = [".", "../out", str(source), f"file://{source}", f"{source}/"]
    galleries = [
        write_gallery(open_dataset(name), tmp_path / f"gallery-{k}", renders=0).parent for k, name in enumerate(named)
    ]
    assert all(digest(gallery) == digest(galleries[0]) for gallery in galleries)
    pages = [path.read_text() for path in galleries[0].rglob("*.html")]
    assert not any(str(tmp_path) in page for page in pages)
    page = (galleries[0] / "scenes" / "a.html").read_text()
    assert "tableverse view out a" in page
    assert "No pictures: out/mjcf/shard-00000.tar" in page


def test_a_dataset_elsewhere_is_named_by_its_address(tmp_path):
    site = Site(tmp_path, "tables", "hf://datasets/me/tables", 1, 0, 0)
    assert list_commands(site.named, "a")[0][1] == "tableverse view hf://datasets/me/tables a"
    assert find_local_folder("hf://datasets/me/tables") is find_local_folder("s3://bucket/tables") is None
