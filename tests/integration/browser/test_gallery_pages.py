"""The gallery in a real Chromium, opened from disk: what somebody sees, types, presses, and hears read out."""

import shutil
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest

from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.physics.render.views import FAST
from tableverse_factory.viz.gallery import pictures
from tableverse_factory.viz.gallery.gallery import write_gallery
from tests.helpers.browser_harness import PHONE, is_blank, pixels, watched
from tests.helpers.gallery_dataset import HOSTILE, scene_members, write_dataset
from tests.helpers.recorded_dataset import two_scenes

LOST = [
    {"scene_id": "lost-1", "name": HOSTILE, "status": "dropped", "stage": "perceive", "reason": "no_table_plane"},
    {"scene_id": "lost-2", "name": "two", "status": "failed", "stage": "place", "error_kind": HOSTILE, "attempts": 2},
    *(
        {"scene_id": f"lost-{k}", "name": f"many {k}", "status": "dropped", "stage": "settle", "reason": "not_at_rest"}
        for k in range(3, 63)
    ),
]
ALERTS = "window.alerts = 0; window.alert = () => { window.alerts += 1; };"


@pytest.fixture(scope="module")
def hostile(tmp_path_factory) -> Path:
    """Scenes with and without a photograph, one that does not load, many lost; foreign text wherever there is text."""
    broken = {**scene_members("broken", photographed=False), "scene.xml": b"<mujoco><body></mujoco>"}
    photo, layout = (scene_members(name, photographed=name == "photo") for name in ("photo", "layout"))
    out = write_dataset(
        tmp_path_factory.mktemp("pages") / "out", {"photo": photo, "layout": layout, "broken": broken}, LOST
    )
    return write_gallery(open_dataset(out), out.with_name("gallery"), renders=1)


@pytest.fixture(scope="module")
def filmed(tmp_path_factory) -> Path:
    """Two scenes with trajectories, everything drawn, by one sample per pixel; the other gallery is of full quality."""
    out = two_scenes(tmp_path_factory.mktemp("films") / "out")
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr(pictures, "QUALITY", FAST)
        return write_gallery(open_dataset(out), out.with_name("gallery"), films=1)


def found(page) -> list[str]:
    """Titles of the cards that the filter found."""
    return page.locator("#found h3").all_inner_texts()


def test_a_scene_is_found_opened_and_seen(page, filmed, screenshots):
    page.goto(filmed.as_uri())
    page.get_by_role("searchbox", name="Find").fill("GREEN block b-2")
    page.get_by_role("status").filter(has_text="1 of 2 scenes").wait_for()
    assert found(page) == ["table b-2"]
    page.screenshot(path=screenshots / "gallery-found.png")
    page.get_by_role("link", name="table b-2").click()
    page.wait_for_url("**/scenes/b-2.html")
    for image in page.locator("main img").all():
        image.scroll_into_view_if_needed()
        assert image.evaluate("image => image.decode().then(() => image.naturalWidth)") >= 320
        assert not is_blank(pixels(image)), image.get_attribute("src")
    page.screenshot(path=screenshots / "gallery-scene.png", full_page=True)
    page.get_by_role("link", name="All scenes").click()
    assert page.locator("#shown .card").count() == 2


def test_filters_stand_in_the_address_and_come_back(page, hostile):
    page.goto(hostile.as_uri())
    page.get_by_label("Reason").select_option("not_at_rest")
    page.get_by_text("60 of 65 scenes").wait_for()
    page.get_by_role("button", name="Next").click()
    page.get_by_text("60 of 65 scenes, page 2 of 3").wait_for()
    assert found(page)[0] == "many 27"
    address = page.url
    assert parse_qs(urlsplit(address).fragment) == {"reason": ["not_at_rest"], "page": ["2"]}
    page.go_back()
    page.get_by_text("60 of 65 scenes, page 1 of 3").wait_for()
    page.goto("about:blank")
    page.goto(address)
    page.get_by_text("60 of 65 scenes, page 2 of 3").wait_for()
    assert page.get_by_label("Reason").input_value() == "not_at_rest"
    page.get_by_role("button", name="Clear").click()
    page.locator("#shown .card").first.wait_for()
    assert urlsplit(page.url).fragment == "scenes"


FILTERS = {
    "status=done": 3,
    "status=usable": 0,
    "status=unusable": 3,
    "status=failed": 1,
    "status=dropped&q=lost-1": 11,
    "score=-5": 3,
    "score=7": 0,
    "depth=100": 3,
    "depth=-1000": 0,
    "drift=100&sort=drift": 3,
    "drift=-5000": 0,
    "label=onerror": 3,
    "reason=NON_TABLETOP_OBJECT": 2,
    "q=no+table+plane": 1,
    "q=nothing+of+the+kind": 0,
}
"""What stands in the address, and how many scenes it finds."""


def test_each_filter_finds_what_it_says(page, hostile):
    for state, titles in FILTERS.items():
        page.goto("about:blank")
        page.goto(f"{hostile.as_uri()}#{state}")
        page.locator(".found:not(:empty)").wait_for()
        assert len(found(page)) == titles, state
        expected = f"{titles} of 65 scenes" if titles else "No scene matches."
        assert page.get_by_role("status").inner_text() == expected, state


def test_foreign_text_stays_text_in_pages_data_and_address(page, hostile):
    page.add_init_script(ALERTS)
    for place in ("index.html", "scenes/photo.html", "scenes/broken.html", "lost.html"):
        page.goto((hostile.parent / place).as_uri())
        assert "onerror=alert(2)" in page.locator("body").inner_text()
    page.goto(f"{hostile.as_uri()}#q=<img src=x onerror=alert(3)>&label={'x' * 5000}&status=%22><script>&page=-9e99")
    page.get_by_text("No scene matches.").wait_for()
    page.goto("about:blank")
    page.goto(f"{hostile.as_uri()}#label=</script>")
    page.get_by_text("3 of 65 scenes").wait_for()
    assert HOSTILE.split("\u2028")[0] in page.locator("#found").inner_text()
    assert page.evaluate("document.querySelector('#labels option').value").startswith("</script><script>")
    assert page.locator("#found a[href^='javascript']").count() == 0
    assert page.evaluate("window.alerts") == 0
    page.goto(f"{hostile.as_uri()}#q=many+3")
    page.locator("#found h3 a").first.click()
    page.wait_for_url("**/lost.html#lost-3")
    assert page.locator("#lost-3").is_visible()


@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.slow)])
def test_axe_objects_to_nothing(page, hostile, filmed, axe, scheme, screenshots):
    page.emulate_media(color_scheme=scheme)
    scene = (filmed.parent / "scenes" / "a-1.html").as_uri()
    places = [hostile.as_uri(), f"{hostile.as_uri()}#q=lost", (hostile.parent / "lost.html").as_uri(), scene]
    for number, place in enumerate([*places, (hostile.parent / "scenes" / "broken.html").as_uri()]):
        page.goto("about:blank")
        page.goto(place)
        if "#q" in place:
            page.locator(".found:not(:empty)").wait_for()
        assert axe(page) == [], place
        page.screenshot(path=screenshots / f"gallery-{scheme}-{number}.png", full_page=True)
    background = pixels(page)[-1, -1].mean()
    assert background > 200 if scheme == "light" else background < 60


def test_the_keyboard_reaches_everything_in_order(page, filmed):
    page.goto(filmed.as_uri())
    reached = []
    for _ in range(15):
        page.keyboard.press("Tab")
        reached.append(
            page.evaluate("document.activeElement.name || document.activeElement.textContent.trim().slice(0, 20)")
        )
        assert page.evaluate("document.activeElement.matches(':focus-visible')")
    assert reached[:5] == ["Skip to the content", "out", "Scenes", reached[3], "q"]
    assert reached[3] in ("Dark", "Light")
    assert [name for name in reached if name in ("label", "status", "score", "depth", "drift", "motions", "sort")] == [
        "label", "status", "score", "depth", "drift", "motions", "sort",
    ]  # fmt: skip
    assert reached[-2:] == ["table a-1", "table b-2"]
    page.keyboard.press("Enter")
    page.wait_for_url("**/scenes/b-2.html")


def test_the_skip_link_leads_past_the_navigation(page, filmed):
    page.goto(filmed.as_uri())
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.id") == "main"


def test_a_film_plays_when_it_is_asked_to(page, filmed):
    page.goto((filmed.parent / "scenes" / "a-1.html").as_uri())
    film = page.get_by_role("button", name="Film of the robot")
    image = film.locator("img")
    assert image.get_attribute("src").endswith(".jpg"), "nothing moves by itself"
    film.press("Space")
    assert image.get_attribute("src").endswith(".webp")
    assert film.get_attribute("aria-pressed") == "true"
    image.evaluate("image => image.decode()")
    assert not is_blank(pixels(film))
    film.press("Enter")
    assert image.get_attribute("src").endswith(".jpg")


def test_a_phone_scrolls_in_one_direction(page, hostile, filmed, screenshots):
    page.set_viewport_size({"width": PHONE[0], "height": PHONE[1]})
    for number, place in enumerate(
        (
            hostile,
            hostile.parent / "lost.html",
            hostile.parent / "scenes" / "photo.html",
            filmed.parent / "scenes" / "a-1.html",
        )
    ):
        page.goto(place.as_uri())
        assert page.evaluate("document.documentElement.scrollWidth") <= PHONE[0], place
        page.screenshot(path=screenshots / f"gallery-phone-{number}.png", full_page=True)
    page.goto(hostile.as_uri())
    assert not page.get_by_label("Status").is_visible()
    page.get_by_text("Filters", exact=True).click()
    page.get_by_label("Status").select_option("failed")
    page.get_by_text("1 of 65 scenes").wait_for()
    assert page.evaluate("document.documentElement.scrollWidth") <= PHONE[0]


def test_the_filter_stays_in_sight(page, hostile):
    page.goto(f"{hostile.as_uri()}#reason=not_at_rest")
    page.locator("#found .card").nth(20).scroll_into_view_if_needed()
    box = page.get_by_role("searchbox", name="Find").bounding_box()
    assert 0 <= box["y"] < 200


def test_without_scripts_the_same_scenes_are_there(browser, hostile):
    context = browser.new_context(java_script_enabled=False)
    page = context.new_page()
    trouble = watched(page)
    page.goto(hostile.as_uri())
    assert page.locator(".card").count() == 3
    assert not page.locator(".filter").is_visible()
    page.get_by_role("link", name="Lost", exact=True).click()
    assert page.locator("#lost-62").is_visible()
    context.close()
    assert trouble == []


def test_a_filter_without_its_data_says_so_and_works_when_it_is_there(browser, hostile, tmp_path):
    folder = Path(shutil.copytree(hostile.parent, tmp_path / "gallery"))
    (folder / "scenes.js").rename(folder / "away.js")
    page = browser.new_page()
    trouble = watched(page)
    page.goto(f"{(folder / 'index.html').as_uri()}#q=nothing-there")
    page.get_by_text("scenes.js does not load: filters do not work.").wait_for()
    assert page.locator("#shown .card").count() == 3
    assert [line for line in trouble if line.startswith("script:")] == []
    (folder / "away.js").rename(folder / "scenes.js")
    page.get_by_role("searchbox", name="Find").fill("lost-2")
    page.get_by_text("1 of 65 scenes").wait_for()
    page.close()


def test_pictures_below_the_window_are_not_loaded_at_first(page, tmp_path):
    """Of cards far below, and of what only filters need, no byte."""
    members = scene_members("scene", photographed=True)
    names = [f"scene-{k:02d}" for k in range(24)]
    out = write_dataset(tmp_path / "out", dict.fromkeys(names, members), [])
    index = write_gallery(open_dataset(out), tmp_path / "gallery", renders=0)
    asked = []
    page.on("request", lambda request: asked.append(request.url))
    page.set_viewport_size({"width": PHONE[0], "height": PHONE[1]})
    page.goto(index.as_uri())
    assert page.locator(".card").count() == 24
    assert sum(url.endswith(".jpg") for url in asked) < 24
    assert not any(url.endswith("scenes.js") for url in asked)
    page.locator(".card").last.scroll_into_view_if_needed()
    image = page.locator(".card img").last
    assert image.evaluate("image => image.decode().then(() => image.naturalWidth)") == 320
    assert np.abs(pixels(image).mean(axis=(0, 1)) - [120, 130, 140]).max() < 12
