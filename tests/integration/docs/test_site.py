"""The documentation as a site: built without a warning, whole, small, and silent towards other hosts."""

import re
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler
from pathlib import Path

import griffe
import pytest

from tests.helpers.docs_pages import PAGES
from tests.helpers.loopback import serving
from tests.helpers.paths import ROOT

IMAGES = ROOT / "docs" / "images"
MAX_LINES = 420
MAX_IMAGES_BYTES = 2_500_000
LOADED = {"script": "src", "img": "src", "link": "href", "iframe": "src"}
SPELLED = {
    r"color(?!\.(png|jpg))": "colour",
    r"licenses|(a|the) license": "licence",
    r"center(ed)?": "centre",
    r"meters?": "metre",
    r"normaliz\w+": "normalise",
    r"data set": "dataset",
    r"trajectorys": "trajectories",
}
"""How these words are not spelled in prose."""

REFERENCE = sorted(
    name for page in (ROOT / "docs" / "api").glob("*.md") for name in re.findall(r"^::: (\S+)", page.read_text(), re.M)
)
"""Names whose docstrings the site shows."""

_CODE = re.compile(r"^ *```.*?^ *```$|`[^`]*`|\]\([^)]*\)|https?://\S+", re.DOTALL | re.MULTILINE)
_IMAGE = re.compile(r"!\[([^\]]*)\]\(([^)]+)\)", re.DOTALL)


class Loads(HTMLParser):
    """What a page makes a browser load."""

    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag == "link" and values.get("rel") in ("canonical", "next", "prev", "edit"):
            return
        if address := values.get(LOADED.get(tag, "")):
            self.addresses.append(address)


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """Built as `make docs` builds it: any warning, such as a dead link or a page outside the navigation, ends it."""
    folder = tmp_path_factory.mktemp("site")
    line = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    done = subprocess.run(line, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-3000:]
    return folder


@pytest.mark.slow  # builds the site, as `make docs` does
def test_the_site_loads_nothing_from_other_hosts(site: Path) -> None:
    pages = sorted(site.rglob("*.html"))
    assert len(pages) > 15
    for page in pages:
        loads = Loads()
        loads.feed(page.read_text())
        assert loads.addresses
        assert [address for address in loads.addresses if re.match(r"(https?:)?//", address)] == [], page
    sheets = "".join(sheet.read_text() for sheet in site.rglob("*.css"))
    assert re.findall(r"url\(['\"]?(?:https?:)?//", sheets) == []


@pytest.fixture(scope="module")
def sources() -> griffe.ModulesCollection:
    """Every package that the reference names, read once."""
    loader = griffe.GriffeLoader(search_paths=[ROOT])
    for package in {name.partition(".")[0] for name in REFERENCE}:
        loader.load(package)
    return loader.modules_collection


@pytest.mark.parametrize("name", REFERENCE)
def test_every_name_in_the_reference_is_documented(name: str, sources: griffe.ModulesCollection) -> None:
    listed = sources[name]
    assert [its.path for its in (listed, *public_within(listed)) if its.docstring is None] == []


def public_within(listed: griffe.Object) -> Iterator[griffe.Object]:
    """Classes, functions and methods that the site shows with it; attributes are told in their class's docstring."""
    for its in listed.members.values():
        if not its.is_alias and (its.is_function or its.is_class) and not its.name.startswith("_"):
            yield its
            yield from public_within(its)


@pytest.mark.slow
def test_start_concepts_and_reference_in_a_browser(served: str, page, screenshots) -> None:
    for name in ("start", "concepts", "api/dataset"):
        page.goto(f"{served}/{name}/")
        page.wait_for_load_state("networkidle")
        assert page.locator("h1").inner_text()
        broken = page.evaluate("[...document.images].filter(i => !i.complete || !i.naturalWidth).map(i => i.src)")
        assert broken == []
        page.screenshot(path=str(screenshots / f"site-{name.replace('/', '-')}.png"))
    search = page.locator("[data-md-component=search-query]")
    search.click()
    search.press_sequentially("certificate")
    page.locator(".md-search-result__item").first.wait_for()


@pytest.fixture
def served(site: Path) -> Iterator[str]:
    class Quiet(SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    with serving(partial(Quiet, directory=str(site))) as address:
        yield address


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_is_short_and_its_pictures_say_what_they_show(page: Path) -> None:
    text = page.read_text()
    assert len(text.splitlines()) <= MAX_LINES
    for words, target in _IMAGE.findall(text):
        assert len(words.split()) >= 3, f"{page.name}: {target} has no words for those who do not see it"
        assert (page.parent / target).is_file(), f"{page.name}: {target}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_words_are_spelled_alike(page: Path) -> None:
    prose = _CODE.sub(" ", page.read_text())
    found = [match[0] for wrong in SPELLED for match in re.finditer(rf"\b({wrong})\b", prose, re.IGNORECASE)]
    assert not found, f"write {[SPELLED[key] for key in SPELLED if any(re.fullmatch(key, w, re.I) for w in found)]}"


def test_pictures_are_used_and_small() -> None:
    pages = "".join(page.read_text() for page in (ROOT / "docs").rglob("*.md")) + (ROOT / "README.md").read_text()
    pictures = [path for path in IMAGES.iterdir() if path.is_file()]
    assert sum(path.stat().st_size for path in pictures) <= MAX_IMAGES_BYTES
    assert [path.name for path in pictures if f"images/{path.name}" not in pages] == []
