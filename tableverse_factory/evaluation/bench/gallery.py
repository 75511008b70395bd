"""What a gallery of many scenes costs: seconds and CPU to make it, bytes and time until its first page is seen."""

import resource
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from schemas.arrow import TABLES
from schemas.scene import Certificate, ExportedScene
from tableverse_factory.core.errors import InputError
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.dataset.shards import TarShard, parquet_bytes, rows_to_table, shard_path, tar_order
from tableverse_factory.viz.gallery.gallery import write_gallery

SHARD_SIZE = 50

_CERTIFICATE = Certificate(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (), (), (), True, False)
"""`TarShard` wants one; what a gallery shows comes from the rows."""

_PAINT = """() => new Promise(seen => new PerformanceObserver(list => {
    const paint = list.getEntriesByName('first-contentful-paint')
    if (paint.length) seen(paint[0].startTime)
}).observe({type: 'paint', buffered: true}))"""
"""Waits inside the page: its policy forbids what polls it from outside, which is code made of text."""

_CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
_LOADS = 5


@dataclass(frozen=True, slots=True)
class GalleryCost:
    """Figures of one gallery.

    Attributes:
        scenes: With a page of their own.
        renders: Of them, drawn from every side.
        jobs: Processes that drew.
        seconds: From the finished dataset to the finished gallery.
        cpu_ms: CPU time per scene, of all processes.
        first_page_bytes: index.html, its style and script, every small picture on it, and what the filters load.
        total_bytes: Of the whole folder.
        first_paint_ms: Median in a headless Chromium, with empty caches; None where there is none.
    """

    scenes: int
    renders: int
    jobs: int
    seconds: float
    cpu_ms: float
    first_page_bytes: int
    total_bytes: int
    first_paint_ms: float | None


def bench_gallery(out: Path, dest: Path, jobs: int, renders: int | None, films: int | None) -> GalleryCost:
    """Makes a gallery and measures it.

    Args:
        out: A dataset.
        dest: A new folder for its gallery.
        jobs: Processes that draw.
        renders: As `write_gallery`.
        films: As `write_gallery`.
    """
    dataset = open_dataset(out)
    before, start = _cpu_s(), time.perf_counter()
    index = write_gallery(dataset, dest, jobs, renders=renders, films=films)
    seconds, cpu_s = time.perf_counter() - start, _cpu_s() - before
    scenes = len(list((dest / "scenes").iterdir()))
    return GalleryCost(
        scenes=scenes,
        renders=len(list((dest / "pictures").glob("*-front.jpg"))),
        jobs=jobs,
        seconds=seconds,
        cpu_ms=1e3 * cpu_s / max(scenes, 1),
        first_page_bytes=first_page_bytes(index),
        total_bytes=sum(path.stat().st_size for path in dest.rglob("*") if path.is_file()),
        first_paint_ms=first_paint_ms(index),
    )


def _cpu_s() -> float:
    """CPU seconds of this process and of all that it waited for."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(each.ru_utime + each.ru_stime for each in used)


def first_page_bytes(index: Path) -> int:
    """What a browser could load for the first page at most, to its end, and for its filters."""
    page = index.read_text(encoding="utf-8")
    pictures = [path for path in (index.parent / "pictures").glob("*-s.jpg") if f"pictures/{path.name}" in page]
    files = [index, *(index.with_name(name) for name in ("gallery.css", "gallery.js", "scenes.js")), *pictures]
    return sum(path.stat().st_size for path in files)


def first_paint_ms(index: Path) -> float | None:
    """The median time to the first contentful paint [ms]; None without playwright or without a Chromium on PATH."""
    chromium = next(filter(None, map(shutil.which, _CHROMIUM)), None)
    try:
        from playwright.sync_api import sync_playwright
    except ImportError:
        return None
    if chromium is None:
        return None
    times = []
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        for _ in range(_LOADS):
            page = browser.new_context().new_page()
            page.goto(index.as_uri())
            times.append(float(page.evaluate(_PAINT)))
        browser.close()
    return sorted(times)[_LOADS // 2]


def write_copies(source: Path, out: Path, scenes: int, done: Callable[[], None] = lambda: None) -> None:
    """Writes a dataset of so many scenes: those of another one over and over, whole, under new ids.

    Args:
        source: A dataset with at least one finished scene.
        out: A new folder.
        scenes: How many finished scenes it has in the end.
        done: Called after each shard.

    Raises:
        InputError: if no scene of the source is finished.
    """
    dataset = open_dataset(source)
    rows = [row for row in dataset.scenes.to_table().to_pylist() if row["status"] == "done"]
    if not rows:
        raise InputError(f"{source}: no scene of it is finished")
    beside = {name: _by_scene(dataset, name) for name in TABLES if name != "scenes"}
    for name in ("mjcf", *TABLES):
        (out / name).mkdir(parents=True)
    (out / "run.json").write_text("{}")
    for shard, first in enumerate(range(0, scenes, SHARD_SIZE)):
        copied = [
            (f"copy-{number:06d}", rows[number % len(rows)]) for number in range(first, min(first + SHARD_SIZE, scenes))
        ]
        _write_shard(dataset, out, shard, copied, beside)
        done()


def _by_scene(dataset: Dataset, name: str) -> dict[str, list[dict[str, Any]]]:
    found: dict[str, list[dict[str, Any]]] = {}
    for row in dataset.table(name).to_table().to_pylist():
        found.setdefault(row["scene_id"], []).append(row)
    return found


def _write_shard(
    dataset: Dataset,
    out: Path,
    shard: int,
    copied: list[tuple[str, dict[str, Any]]],
    beside: dict[str, dict[str, list[dict[str, Any]]]],
) -> None:
    tables: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
    with shard_path(out, "mjcf", shard).open("wb") as file:
        tar = TarShard(file)
        for scene_id, row in sorted(copied, key=lambda each: tar_order(each[0])):
            files = tuple(sorted(dataset.scene(row["scene_id"]).files().items()))
            offset, size = tar.add(ExportedScene(scene_id, files, _CERTIFICATE, {}, (), ()))
            place = {"shard": shard, "tar_offset": offset, "tar_size": size}
            tables["scenes"].append({**row, **place, "scene_id": scene_id, "name": scene_id})
            for name, rows in beside.items():
                tables[name] += [{**each, "scene_id": scene_id} for each in rows.get(row["scene_id"], [])]
        tar.close()
    for name, schema in TABLES.items():
        shard_path(out, name, shard).write_bytes(parquet_bytes(rows_to_table(tables[name], schema)))
