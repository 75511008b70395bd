"""The harness sees what goes wrong: otherwise every test in a browser would be green for nothing."""

import numpy as np

from tests.helpers.browser_harness import is_blank, pixels, stays_here, watched

PAGE = """<!doctype html><html lang="en"><title>t</title><main><h1>Here</h1>{}</main></html>"""


def test_what_goes_wrong_in_a_page_is_noticed(browser, tmp_path):
    (tmp_path / "bad.html").write_text(
        PAGE.format("<img src='http://192.0.2.1/x.png'><script>console.error('broken'); nothing.here</script>")
    )
    page = browser.new_page()
    trouble = watched(page)
    page.goto((tmp_path / "bad.html").as_uri(), wait_until="domcontentloaded")
    page.close()
    said = " ".join(trouble)
    assert "console: broken" in said
    assert "nothing is not defined" in said
    assert "leaves: http://192.0.2.1/x.png" in said


def test_a_sound_page_passes_and_is_seen(page, axe, screenshots, tmp_path):
    (tmp_path / "good.html").write_text(PAGE.format("<p>Good day</p>"))
    page.goto((tmp_path / "good.html").as_uri())
    assert axe(page) == []
    assert not is_blank(pixels(page))
    assert screenshots.is_dir()


def test_what_people_cannot_use_is_noticed(page, axe, tmp_path):
    (tmp_path / "poor.html").write_text(PAGE.format("<img src='data:,'><p style='color:#ddd'>Faint</p>"))
    page.goto((tmp_path / "poor.html").as_uri())
    rules = {line.partition(":")[0] for line in axe(page)}
    assert {"image-alt", "color-contrast"} <= rules


def test_blank_is_blank_and_here_is_here():
    assert is_blank(np.full((20, 20, 3), 250, dtype=np.uint8))
    assert stays_here("file:///a") and stays_here("ws://127.0.0.1:8080/")  # noqa: PT018
    assert not stays_here("https://example.org/")
    assert not stays_here("http://127.0.0.1.example.org/")
