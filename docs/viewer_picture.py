"""Takes the picture of docs/viewer.md in a headless Chromium: `python docs/viewer_picture.py OUT SCENE TASK`.

OUT is a dataset with trajectories; the picture shows one of them under way. It needs playwright and Chromium.
"""

import argparse
import io
import shutil
import time
from pathlib import Path

from PIL import Image
from playwright.sync_api import Page, sync_playwright

from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.viz.viewer.scene_cache import SceneCache
from tableverse_factory.viz.viewer.server import Viewer

DEST = Path(__file__).parent / "images" / "viewer.jpg"
WIDTH, HEIGHT = 1280, 760
JPEG_QUALITY = 82
DRAWN_S = 12.0
"""Until software has drawn everything, textures too."""


def main() -> None:
    """Opens the scene as its photograph shows it, then with a motion under way, and puts both side by side."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out")
    parser.add_argument("scene")
    parser.add_argument("task")
    parser.add_argument("--share", type=float, default=0.6, help="of the motion that has passed")
    parser.add_argument("--dest", type=Path, default=DEST)
    asked = parser.parse_args()
    viewer = Viewer(SceneCache(open_dataset(asked.out)), asked.scene, "127.0.0.1", 0)
    with sync_playwright() as playwright:
        flags = ["--no-sandbox", "--enable-unsafe-swiftshader"]
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        page.set_default_timeout(120_000)
        page.goto(viewer.url)
        page.get_by_role("heading", level=1).wait_for()
        first = shot(page)
        page.get_by_role("tab", name="Motion", exact=True).click()
        page.get_by_label("Task", exact=True).first.click()
        page.get_by_role("option", name=asked.task).click()
        page.get_by_text("phase: pre-grasp").wait_for()
        field = page.get_by_role("textbox").last
        field.fill(f"{asked.share * viewer_duration(viewer):.2f}")
        field.press("Enter")
        second = shot(page)
        browser.close()
    viewer.stop()
    both = Image.new("RGB", (WIDTH, 2 * HEIGHT + 8), "white")
    both.paste(first, (0, 0))
    both.paste(second, (0, HEIGHT + 8))
    both.save(asked.dest, "JPEG", quality=JPEG_QUALITY, optimize=True)


def viewer_duration(viewer: Viewer) -> float:
    """Of the motion that the only browser looks at [s]."""
    (session,) = viewer.sessions()
    return session.duration_s


def shot(page: Page) -> Image.Image:
    """The page when all is drawn, without viser's word that there is no GPU here."""
    time.sleep(DRAWN_S)
    notice = page.locator(".mantine-Notification-closeButton")
    for number in reversed(range(notice.count())):
        notice.nth(number).click()
    time.sleep(1.0)
    return Image.open(io.BytesIO(page.screenshot())).convert("RGB")


if __name__ == "__main__":
    main()
