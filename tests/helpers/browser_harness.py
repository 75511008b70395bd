"""Pages in a real Chromium: fixtures for whatever people look at, the gallery as much as the viewer.

Nothing is downloaded: it is the system's own browser, and it resolves no name but this machine's.
"""

import os
import shutil
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

ARTIFACTS = Path(__file__).resolve().parents[2] / "test-artifacts"

DESKTOP, PHONE = (1280, 800), (390, 844)

_LOOPBACK = ("localhost", "127.0.0.1", "::1")
_FLAGS = (
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE localhost, EXCLUDE 127.0.0.1",
    "--enable-unsafe-swiftshader",  # WebGL without a GPU, for the viewer
    "--disable-background-networking",
)


def chromium() -> str:
    """The browser on this machine. Where tests are what stands between a mistake and its users, it must be there."""
    found = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if found is None:
        said = "no Chromium on PATH: apt-get install chromium"
        if os.environ.get("CI"):
            pytest.fail(said, pytrace=False)
        pytest.skip(said)
    return found


@pytest.fixture(scope="module")
def browser() -> "Iterator[Browser]":
    """A headless Chromium for a file of tests. No longer: while it runs, `asyncio.run` is refused in this thread."""
    path = chromium()
    from playwright.sync_api import sync_playwright

    flags = [*_FLAGS, "--no-sandbox"] if os.geteuid() == 0 else list(_FLAGS)
    with sync_playwright() as playwright:
        running = playwright.chromium.launch(executable_path=path, args=flags)
        yield running
        running.close()


@pytest.fixture
def page(browser: "Browser") -> "Iterator[Page]":
    """A fresh page; its test fails on an error in the console, on a script's error, and on a request that leaves."""
    context = browser.new_context(viewport={"width": DESKTOP[0], "height": DESKTOP[1]}, reduced_motion="reduce")
    fresh = context.new_page()
    trouble = watched(fresh)
    yield fresh
    context.close()
    assert trouble == []


def watched(page: "Page") -> list[str]:
    """A list that fills with what goes wrong in a page while it is used."""
    trouble: list[str] = []
    page.on("console", lambda said: said.type == "error" and trouble.append(f"console: {said.text}"))
    page.on("pageerror", lambda error: trouble.append(f"script: {error}"))
    page.on("request", lambda request: stays_here(request.url) or trouble.append(f"leaves: {request.url}"))
    page.on("websocket", lambda socket: stays_here(socket.url) or trouble.append(f"leaves: {socket.url}"))
    return trouble


def stays_here(url: str) -> bool:
    """Whether a request is answered by this machine."""
    parts = urlsplit(url)
    return parts.scheme in ("file", "data", "blob", "about") or parts.hostname in _LOOPBACK


@pytest.fixture(scope="session")
def screenshots() -> Path:
    """Where pictures of pages are kept, to be looked at; CI keeps them as an artefact."""
    ARTIFACTS.mkdir(exist_ok=True)
    return ARTIFACTS


@pytest.fixture
def axe() -> "Callable[[Page], list[str]]":
    """Asks axe-core, and answers what it objects to: a line per rule and element; all rules, those of habit too."""
    from axe_playwright_python.sync_playwright import Axe

    def violations(page: "Page") -> list[str]:
        # It would fetch style sheets once more to look for locked orientations, which a page's own policy may forbid.
        options = {"resultTypes": ["violations"], "preload": False}
        found = Axe().run(page, options=options).response["violations"]
        return [f"{each['id']}: {node['target']} {node['html'][:120]}" for each in found for node in each["nodes"]]

    return violations


def pixels(shown: "Page | Locator") -> np.ndarray:
    """A page or a part of it as it is seen. Shape (height, width, 3)."""
    return np.asarray(Image.open(BytesIO(shown.screenshot())).convert("RGB"))


def is_blank(picture: np.ndarray) -> bool:
    """Whether nothing is to be seen: next to no pixel differs from the rest."""
    return float(np.asarray(Image.fromarray(picture).convert("L"), dtype=np.float64).std()) < 4.0
