"""Takes the picture of docs/gallery.md in a headless Chromium: `python docs/gallery_picture.py GALLERY`.

GALLERY is a folder that `tableverse report` wrote. It needs playwright and the system's Chromium.
"""

import argparse
import io
import shutil
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

DEST = Path(__file__).parent / "images" / "gallery.jpg"
WIDTH, HEIGHT = 1280, 900
JPEG_QUALITY = 80


def main() -> None:
    """Opens the gallery, filters it, and writes what is to be seen."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("gallery", type=Path)
    parser.add_argument("--state", default="score=8&sort=depth", help="of the filters, as in the address")
    parser.add_argument("--dest", type=Path, default=DEST)
    asked = parser.parse_args()
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, reduced_motion="reduce")
        page.goto(f"{(asked.gallery / 'index.html').resolve().as_uri()}#{asked.state}")
        page.locator("#found .card").first.wait_for()
        page.locator("#scenes").evaluate("heading => heading.scrollIntoView()")
        page.wait_for_function("[...document.images].slice(0, 12).every(image => image.complete)")
        taken = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
        browser.close()
    taken.save(asked.dest, "JPEG", quality=JPEG_QUALITY, optimize=True)


if __name__ == "__main__":
    main()
