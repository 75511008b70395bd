"""Every block of the cookbook runs, section by section, and prints what the page says."""

import contextlib
import io
import re
from pathlib import Path

import pytest

import tableverse_factory
from tests.helpers.docs_pages import Block, blocks
from tests.helpers.learnable_dataset import write_learnable_dataset
from tests.helpers.paths import ROOT

PAGE = ROOT / "docs" / "cookbook.md"

pytestmark = pytest.mark.filterwarnings("ignore:This DataLoader will create 2 worker processes")


def sections() -> dict[str, list[tuple[Block, str | None]]]:
    """The Python blocks below each heading, each with the text that stands right below it."""
    headings = [(n, line[3:]) for n, line in enumerate(PAGE.read_text().splitlines(), 1) if line.startswith("## ")]
    found: dict[str, list[tuple[Block, str | None]]] = {title: [] for _, title in headings}
    page = blocks(PAGE)
    for index, block in enumerate(page):
        if block.language == "python":
            following = page[index + 1] if index + 1 < len(page) else None
            end = block.line + len(block.text.splitlines())
            below = following is not None and following.language == "text" and following.line == end + 3
            title = [title for line, title in headings if line < block.line][-1]
            found[title].append((block, following.text if following is not None and below else None))
    return found


@pytest.fixture(scope="session")
def out(tmp_path_factory) -> Path:
    return write_learnable_dataset(tmp_path_factory.mktemp("cookbook") / "out")


@pytest.mark.parametrize("title", sections())
def test_a_section_prints_what_it_says(title, out, monkeypatch):
    monkeypatch.chdir(out.parent)
    names: dict[str, object] = {"__name__": "__cookbook__"}
    for block, expected in sections()[title]:
        printed = io.StringIO()
        code = "\n" * (block.line - 1) + block.text
        with contextlib.redirect_stdout(printed):
            exec(compile(code, str(PAGE), "exec"), names)  # noqa: S102 - our own page
        assert printed.getvalue().strip() == (expected or "").strip(), f"line {block.line}"


def test_the_page_has_its_recipes():
    found = sections()
    assert len(found) >= 5
    assert all(found.values())
    assert sum(expected is not None for blocks in found.values() for _, expected in blocks) >= 12
    assert not re.search(r"```text\n```", PAGE.read_text()), "an answer is missing"


def test_the_reference_has_all_that_learners_import():
    page = (ROOT / "docs" / "api" / "dataset.md").read_text()
    listed = re.findall(r"^::: tableverse_factory\.delivery\.learning\.\w+\.(\w+)$", page, re.MULTILINE)
    assert set(listed) == set(tableverse_factory.__all__) - {"Dataset", "Scene", "open_dataset", "__version__"}
