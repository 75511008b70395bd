"""The viewer in a real browser: what is seen changes as the controls say, and nobody else can look."""

import time
from collections.abc import Callable

import numpy as np
import pytest
from axe_playwright_python.sync_playwright import Axe

from tableverse_factory.viz.viewer.server import Viewer
from tests.helpers.browser_harness import is_blank, pixels

pytestmark = pytest.mark.filterwarnings("ignore:Queued a .* on a closed connection")

IS_OURS = "element => element.closest('.tableverse') !== null"

SIZE = {"width": 720, "height": 440}
"""Software draws it quickly."""

OF_VISER = {
    "aria-input-field-name": "sliders carry an empty aria-label beside their visible label",
    "button-name": "the buttons that close a notification and open settings have pictures and no names",
    "color-contrast": "labels of its controls are light grey",
    "label": "a slider's field for numbers and a dropdown's hidden field have no label",
    "landmark-one-main": "its page has no main landmark",
    "page-has-heading-one": "its page has no heading; ours is in the tab `Scene`",
    "region": "its panel and canvas lie in no landmark",
}
"""Rules that viser's own page breaks, with what is wrong: none of it is ours to change."""


@pytest.fixture
def small(page):
    page.set_viewport_size(SIZE)
    page.set_default_timeout(60_000)
    return page


def until(holds: Callable[[], bool], seconds: float = 60.0) -> bool:
    end = time.monotonic() + seconds
    while not (held := holds()) and time.monotonic() < end:
        time.sleep(0.4)
    return held


def visit(page, address: str):
    page.goto(address)
    page.get_by_role("heading", level=1).wait_for()
    assert until(lambda: green_at(page) is not None)
    notice = page.locator(".mantine-Notification-closeButton")  # that software draws
    if notice.count():
        notice.first.click()
    return page


def tab(page, name: str) -> None:
    page.get_by_role("tab", name=name, exact=True).click()


def tick(page, name: str) -> None:
    page.get_by_role("checkbox", name=name).click()


def choose(page, label: str, option: str) -> None:
    page.get_by_label(label, exact=True).first.click()
    page.get_by_role("option", name=option).first.click()


def canvas(page) -> np.ndarray:
    return pixels(page.locator("canvas").last).astype(int)


def green_at(page) -> np.ndarray | None:
    """Where the green block is seen, its middle in pixels (down, right)."""
    red, green, blue = np.moveaxis(canvas(page), 2, 0)
    seen = np.argwhere((green > red + 35) & (green > blue + 35))
    return seen.mean(axis=0) if len(seen) > 60 else None


def moved(page, before: np.ndarray, most: float = 8.0) -> bool:
    now = green_at(page)
    return now is None or float(np.abs(now - before).max()) > most


def differs(page, before: np.ndarray, share: float = 0.004) -> bool:
    return bool((np.abs(canvas(page) - before).max(axis=2) > 24).mean() > share)


@pytest.mark.slow  # draws without a GPU; test_session.py and test_panel_parts.py hold the controls
@pytest.mark.heavy
def test_a_scene_is_seen_as_the_controls_say_and_texts_stay_texts(small, viewer, screenshots):
    visit(small, viewer.url)
    assert not is_blank(canvas(small).astype(np.uint8))
    assert small.get_by_alt_text("The photograph that this scene was made from").is_visible()
    facts = small.get_by_role("region", name="Facts")
    assert "<script>alert(1)</script>" in facts.inner_text()
    assert facts.locator("script, img").count() == 0
    assert "0.02 mm" in facts.inner_text()
    small.screenshot(path=screenshots / "viewer-scene.png")
    found = Axe().run(small).response["violations"]
    assert {each["id"] for each in found} <= OF_VISER.keys()
    targets = [node["target"][0] for each in found for node in each["nodes"]]
    ours = f"nodes => nodes.some({IS_OURS})"  # of those still there: notices come and go
    assert [target for target in targets if small.locator(target).evaluate_all(ours)] == []
    _layouts_pieces_contacts_and_tables(small, screenshots)


def _layouts_pieces_contacts_and_tables(small, screenshots):
    """What is seen changes; on the same page, for opening another costs seconds where software draws."""
    tab(small, "Show")
    at = green_at(small)
    choose(small, "Layout", "observed")
    assert until(lambda: moved(small, at))
    assert green_at(small)[1] > at[1]  # the picture had it further to the right
    choose(small, "Layout", "settled")
    assert until(lambda: not moved(small, at, 2.0))
    before = canvas(small)
    choose(small, "Ghosts of", "observed")
    assert until(lambda: differs(small, before))
    tick(small, "Collision pieces")
    tick(small, "Visual meshes")
    assert until(lambda: green_at(small) is None or moved(small, at))  # pieces have other colours
    tick(small, "Contacts")
    small.get_by_text("contacts,").wait_for()
    before = canvas(small)
    choose(small, "Table", "gingham")
    assert until(lambda: differs(small, before, 0.05))
    small.screenshot(path=screenshots / "viewer-pieces.png")


@pytest.mark.slow
def test_motions_and_physics_play(small, viewer, screenshots):
    visit(small, viewer.url)
    tab(small, "Motion")
    choose(small, "Task", "task_001")
    small.get_by_text("failed in grasp: not grasped (no finger touched it)").wait_for()
    choose(small, "Task", "task_000")
    small.get_by_text("phase: pre-grasp").wait_for()
    time.sleep(2.0)
    before = canvas(small)
    small.get_by_role("button", name="Play").last.click()
    small.get_by_text("phase: post-place").wait_for()
    assert until(lambda: differs(small, before))  # the arm is elsewhere
    assert small.get_by_text("success").is_visible()
    assert until(lambda: not any(session.playing for session in viewer.sessions()))
    small.screenshot(path=screenshots / "viewer-motion.png")
    choose(small, "Task", "task_002")
    small.get_by_text("failed: no grasp").wait_for()
    _physics_while_somebody_looks(small, viewer, screenshots)


def _physics_while_somebody_looks(small, viewer, screenshots):
    tab(small, "Scene")
    small.get_by_role("button", name="Picture's camera").click()
    tab(small, "Show")
    time.sleep(1.0)
    at = green_at(small)
    choose(small, "Layout", "rectified")
    assert until(lambda: moved(small, at))
    tab(small, "Physics")
    small.get_by_role("button", name="Play").last.click()
    assert until(lambda: not moved(small, at, 3.0))  # it fell to where it stands
    choose(small, "Object", "obj_001")
    small.get_by_role("button", name="right", exact=True).click()
    assert until(lambda: moved(small, at))
    small.screenshot(path=screenshots / "viewer-physics.png")
    (session,) = viewer.sessions()
    assert session.playing
    small.goto("about:blank")
    assert until(lambda: not viewer.sessions())
    time.sleep(0.1)
    then = session.simulated_s
    time.sleep(0.5)
    assert session.simulated_s == then  # nobody looks, nothing moves


@pytest.mark.slow
def test_scenes_are_searched_and_two_browsers_do_not_disturb_each_other(small, viewer, browser):
    visit(small, viewer.url)
    small.get_by_role("textbox").first.fill("c-3")
    small.get_by_text("dropped at settle: not at rest").wait_for()
    small.get_by_role("textbox").first.fill("")
    small.get_by_text("3 of 3 scenes found").wait_for()
    small.get_by_role("button", name="‹", exact=True).click()
    small.get_by_text("No photograph: this scene was made from a layout.").wait_for()
    address = small.get_by_role("link", name="Link to this scene").get_attribute("href")
    other = browser.new_page(viewport=SIZE)
    visit(other, viewer.url + address)
    assert other.get_by_text("No photograph").is_visible()
    small.get_by_role("button", name="‹", exact=True).click()
    small.get_by_alt_text("The photograph that this scene was made from").wait_for()
    assert other.get_by_text("No photograph").is_visible()
    assert len(viewer.sessions()) == 2
    other.close()


@pytest.mark.heavy
def test_a_page_from_elsewhere_sees_nothing(browser, viewer):
    assert until(lambda: not viewer.sessions())
    elsewhere = Viewer(viewer._scenes, "b-2", "127.0.0.1", 0)
    try:
        page = browser.new_page(viewport={"width": 400, "height": 300})
        page.goto(f"{elsewhere.url}?websocket={viewer.url.replace('http', 'ws')}")
        time.sleep(3.0)
        assert not viewer.sessions()
        assert page.get_by_role("heading", level=1).count() == 0
        page.close()
    finally:
        elsewhere.stop()
