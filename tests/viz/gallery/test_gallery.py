"""The gallery of datasets made by hand: safe against their text, whole, self-contained, readable by machines."""

import hashlib
import json
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from urllib.parse import unquote

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from schemas.tables import TABLES
from tableverse_factory.cli.main import app
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.geometry.math.camera import project
from tableverse_factory.geometry.math.transforms import invert_pose, transform_points
from tableverse_factory.viz.gallery.gallery import write_gallery
from tests.helpers.gallery_dataset import CAMERA, EYE, HOSTILE, scene_members, write_dataset

pytestmark = pytest.mark.heavy

LOST = [
    {"scene_id": "lost-1", "name": HOSTILE, "status": "dropped", "stage": "perceive", "reason": "no_table_plane"},
    {"scene_id": "lost-2", "name": "two", "status": "failed", "stage": "place", "error_kind": HOSTILE, "attempts": 2},
    {"scene_id": "lost-3", "status": "dropped", "stage": "settle", "reason": "not_at_rest", "detail": HOSTILE},
]


class Page(HTMLParser):
    """What a browser would make of a page, as far as it matters here."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str]]] = []
        self.text = ""
        self.path = path
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, {key: value or "" for key, value in attrs}))

    def handle_data(self, data: str) -> None:
        self.text += data

    def all(self, *tags: str) -> list[dict[str, str]]:
        return [attributes for tag, attributes in self.tags if tag in tags]


@pytest.fixture(scope="module")
def out(tmp_path_factory) -> Path:
    broken = {**scene_members("broken", photographed=False), "scene.xml": b"<mujoco><body></mujoco>"}
    done = {
        "photo": scene_members("photo", photographed=True),
        "layout": scene_members("layout", photographed=False),
        "broken": broken,
    }
    return write_dataset(tmp_path_factory.mktemp("data") / "out", done, LOST)


@pytest.fixture(scope="module")
def gallery(out) -> Path:
    return write_gallery(open_dataset(out), out.with_name("gallery")).parent


@pytest.fixture(scope="module")
def pages(gallery) -> list[Page]:
    found = [Page(path) for path in sorted(gallery.rglob("*.html"))]
    names = [page.path.relative_to(gallery).as_posix() for page in found]
    assert names == ["index.html", "lost.html", "scenes/broken.html", "scenes/layout.html", "scenes/photo.html"]
    return found


def test_no_text_of_the_dataset_becomes_markup(pages):
    for page in pages:
        assert [script["src"].rpartition("/")[2] for script in page.all("script")] == ["gallery.js"]
        assert not [name for _, attributes in page.tags for name in attributes if name.startswith("on")]
        assert not page.all("iframe", "object", "embed", "base", "style")
        assert "style" not in {name for _, attributes in page.tags for name in attributes}
        assert all(image["src"].endswith(".jpg") for image in page.all("img"))
        assert "49 &" not in page.text


def test_hostile_text_is_shown_as_it_is(pages):
    shown = {page.path.stem: page.text for page in pages}
    for name in ("index", "lost", "photo", "layout", "broken"):
        assert HOSTILE.replace("&amp;", "&") in shown[name] or HOSTILE in shown[name]


def test_the_search_index_is_plain_data(gallery):
    text = (gallery / "scenes.js").read_bytes()
    assert b"<" not in text
    assert max(text) < 128, "a line separator would end a line of the script"
    index = index_of(gallery)
    assert [entry[0] for entry in index["done"]] == ["photo", "layout", "broken"]
    assert [entry[0] for entry in index["lost"]] == ["lost-1", "lost-2", "lost-3"]
    assert all((gallery / entry[-1]).is_file() for entry in index["lost"])
    assert index["labels"] == [HOSTILE]
    assert index["lost"][1][3] == HOSTILE


def index_of(gallery: Path) -> dict:
    """What the filters search."""
    text = (gallery / "scenes.js").read_text()
    return json.loads(text.removeprefix("window.TABLEVERSE = ").removesuffix(";\n"))


def test_every_link_leads_somewhere_and_nothing_leads_out(pages):
    ids = {page.path.resolve(): {attributes.get("id") for _, attributes in page.tags} for page in pages}
    for page in pages:
        for attributes in page.all("a", "img", "script", "link"):
            link = attributes.get("href", attributes.get("src", ""))
            if link.startswith("data:"):
                continue
            assert "://" not in link
            name, _, anchor = unquote(link).partition("#")
            target = (page.path.parent / name).resolve() if name else page.path.resolve()
            assert target.is_file(), link
            assert not anchor or anchor in ids[target], link


def test_pages_are_accessible(pages):
    for page in pages:
        assert all(image["alt"].strip() for image in page.all("img"))
        assert all(image["width"].isdigit() and image["height"].isdigit() for image in page.all("img"))
        levels = [int(tag[1]) for tag, _ in page.tags if tag in ("h1", "h2", "h3", "h4")]
        assert levels[0] == 1
        assert levels.count(1) == 1
        assert all(b - a <= 1 for a, b in pairwise(levels))
        assert page.all("html")[0]["lang"] == "en"
        ids = [attributes["id"] for _, attributes in page.tags if "id" in attributes]
        assert len(set(ids)) == len(ids)
        labels = {a[key] for _, a in page.tags for key in ("aria-labelledby",) if key in a}
        assert labels <= set(ids)


def test_reasons_and_figures_are_told(pages):
    shown = {page.path.stem: " ".join(page.text.split()) for page in pages}
    assert "no table plane" in shown["index"]
    assert "not at rest" in shown["lost"]
    assert "123 g" in shown["photo"]
    assert "80 × 80 × 80" in shown["photo"]
    assert "tableverse extract" in shown["photo"]
    assert "No pictures" in shown["broken"]
    assert "does not load" in shown["broken"]
    assert "1 refused" in shown["photo"]
    assert "toppled, slid, left out since the picture" in shown["photo"]


def test_what_toppled_is_a_reason_to_filter_by(gallery):
    index = json.loads((gallery / "scenes.js").read_text().removeprefix("window.TABLEVERSE = ").rstrip(";\n"))
    assert {tuple(codes) for _, _, _, _, codes, *_ in index["done"]} >= {("NON_TABLETOP_OBJECT", "toppled")}
    assert '<option value="toppled">' in (gallery / "index.html").read_text()


def test_where_metres_come_from_is_told_and_filtered_by(pages, gallery):
    shown = {page.path.stem: " ".join(page.text.split()) for page in pages}
    assert "scalemeasured by a known length, ±1.3 % camerafrom EXIF" in shown["photo"]
    assert "scalegiven by the layout camera–" in shown["layout"]
    assert [entry[-1] for entry in index_of(gallery)["done"]] == ["measured", "given", "given"]
    (index,) = [page for page in pages if page.path.stem == "index"]
    options = {attributes.get("value") for attributes in index.all("option")}
    assert {"measured", "given"} <= options
    assert "sensor" not in options, "only what is there"


def test_the_twin_is_seen_by_the_camera_of_the_photograph(gallery):
    """The red box and the green box appear where the photograph's camera projects them."""
    twin = np.asarray(Image.open(gallery / "pictures" / "photo-twin.jpg")).astype(int)
    boxes = np.array([[0.0, -0.04, 0.04], [0.15, 0.025, 0.06]])
    pixels = project(transform_points(invert_pose(EYE), boxes), CAMERA) * twin.shape[1] / CAMERA.width
    (red_x, red_y), (green_x, green_y) = np.rint(pixels).astype(int)
    red, green = twin[red_y, red_x], twin[green_y, green_x]
    assert red[0] > red[1] + 40
    assert green[1] > green[0] + 40


def test_pictures_are_small_enough_for_a_page(gallery):
    assert not (gallery / "pictures" / "layout-photo.jpg").exists()
    thumbs = list((gallery / "pictures").glob("*-s.jpg"))
    assert len(thumbs) == 6
    assert max(path.stat().st_size for path in thumbs) < 30_000


def test_the_dataset_stays_as_it_was(out, gallery):
    assert {name.partition("/")[0] for name in digest(out)} == {"mjcf", "run.json", *TABLES}


@pytest.mark.slow
@pytest.mark.usefixtures("full_quality")
def test_two_processes_draw_the_same_gallery(out, tmp_path):
    before = digest(out)
    one, two = (write_gallery(open_dataset(out), tmp_path / str(jobs), jobs=jobs).parent for jobs in (1, 2))
    assert digest(out) == before
    assert digest(one) == digest(two)


def digest(folder: Path) -> dict[str, str]:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def test_many_scenes_are_dealt_out_to_pages(tmp_path):
    members = {"scene.xml": b"no xml", "meta.json": b"{}"}
    lost = [{"scene_id": f"lost-{k}", "status": "dropped", "stage": "place", "reason": "x"} for k in range(230)]
    out = write_dataset(tmp_path / "out", {f"scene-{k:03d}": members for k in range(60)}, lost)
    index = write_gallery(open_dataset(out), tmp_path / "gallery")
    folder = index.parent
    cards = [len(Page(folder / name).all("article")) for name in ("index.html", "page-0002.html", "page-0003.html")]
    assert cards == [24, 24, 12]
    assert not (folder / "page-0004.html").exists()
    assert (folder / "lost-0003.html").is_file()
    assert not (folder / "lost-0004.html").exists()
    assert "../page-0003.html#scenes" in (folder / "scenes" / "scene-059.html").read_text()


def test_an_empty_dataset_has_a_gallery_that_says_so(tmp_path):
    (tmp_path / "out" / "scenes").mkdir(parents=True)
    index = write_gallery(open_dataset(tmp_path / "out"), tmp_path / "gallery")
    assert "No shard of this dataset is committed yet" in index.read_text()


@pytest.mark.parametrize(
    "meta",
    [
        b"{}",
        *(
            pytest.param(meta, marks=pytest.mark.slow)
            for meta in (b"[]", b'{"assessment": [], "left_out": 3}', b"\xff", b"{" * 5000)
        ),
    ],
)
def test_a_damaged_meta_costs_the_pictures_of_one_scene(tmp_path, meta):
    members = {**scene_members("scene", photographed=False), "meta.json": meta}
    out = write_dataset(tmp_path / "out", {"scene": members}, [])
    index = write_gallery(open_dataset(out), tmp_path / "gallery")
    assert "No pictures" in index.read_text()


def test_the_command_says_what_it_could_not_open(tmp_path):
    out = write_dataset(tmp_path / "out", {"scene": scene_members("scene", photographed=False)}, [])
    (out / "mjcf" / "shard-00000.tar").write_bytes(b"")
    result = CliRunner().invoke(app, ["report", str(out)])
    assert result.exit_code == 0
    said = " ".join(result.stderr.split())
    assert "scenes could not be opened: " in said
    assert "mjcf/shard-00000.tar is damaged (0 bytes, not " in said


def test_an_id_that_is_no_file_name_is_refused(tmp_path):
    out = write_dataset(tmp_path / "out", {"../../evil": {"scene.xml": b""}}, [])
    with pytest.raises(InputError, match="damaged"):
        write_gallery(open_dataset(out), tmp_path / "gallery")
    assert not (tmp_path.parent / "evil.html").exists()


def test_the_command_prints_where_to_look(tmp_path):
    out = write_dataset(tmp_path / "out", {"scene": {"scene.xml": b"", "meta.json": b"{}"}}, [])
    for _ in range(2):  # the second time it replaces its own
        result = CliRunner().invoke(app, ["report", str(out)])
        assert result.exit_code == 0, result.output
        assert Path(result.stdout.strip()).resolve() == tmp_path / "out-gallery" / "index.html"
