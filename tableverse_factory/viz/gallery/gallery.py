"""The gallery: one folder of HTML, CSS and JPEG that opens from disk, with no network and no server.

Every text in it comes from pictures, labels and models that nobody vouches for: templates escape everything, the
script builds its nodes from text, and ids are checked before they become names of files.
"""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

from tableverse_factory import __version__, pipeline
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.viz.gallery.destination import checked_dest, folder_of, put_in_place, write_mark
from tableverse_factory.viz.gallery.index import LOST_PAGE_SIZE, NAME, write_index
from tableverse_factory.viz.gallery.pages import Site, lost_name, page_name
from tableverse_factory.viz.gallery.records import Records, SceneRecord, charts, read_records
from tableverse_factory.viz.gallery.scene import Card, Order, forget_datasets, write_scene

PAGE_SIZE = 24

FEW, FILMS, SAMPLE = 60, 6, 6
"""So many scenes are all drawn by default, with so many films each; of more, a sample: a scene takes some four seconds,
a film three.
"""

STAGES = ("manifest", "read_layout", *(stage.name for stage in pipeline.STAGES))
"""In the order in which they lose scenes."""

_STATIC = ("gallery.css", "gallery.js")
_CHUNK = 4
"""Scenes that a process is given at a time where most are not drawn: each takes some hundredths of a second."""


@dataclass(frozen=True, slots=True)
class GalleryOptions:
    """How much is drawn. Every scene has its page and its small picture in any case.

    Attributes:
        renders: So many scenes, the first ones, are drawn from every side.
        films: At most so many of each of these.
    """

    renders: int
    films: int


def usual_effort(n_done: int, renders: int | None = None, films: int | None = None) -> GalleryOptions:
    """What is asked for, and where nothing is: everything of a few scenes; of many, the first ones, without films."""
    few = n_done <= FEW
    usual = n_done if few else SAMPLE
    return GalleryOptions(usual if renders is None else renders, (FILMS if few else 0) if films is None else films)


def write_gallery(
    dataset: Dataset,
    dest: Path,
    jobs: int = 1,
    progress: Callable[[int, int], None] | None = None,
    renders: int | None = None,
    films: int | None = None,
    robot: str | None = None,
) -> Path:
    """Writes the gallery of a dataset and returns the path of its index.html.

    The dataset is only read. `dest` may be new, empty, or an earlier gallery with nothing else in it, which is replaced
    when the new one is complete.

    Args:
        dataset: Finished or not; only committed shards are shown.
        dest: The folder.
        jobs: Processes that draw.
        progress: Called with the number of scenes drawn and of all.
        renders: How many scenes are drawn from every side (`usual_effort`).
        films: At most so many of each of these (`usual_effort`).
        robot: The arm of recordings whose robot is none of ours: a file, or `menagerie:NAME`.

    Raises:
        InputError: if `dest` holds something else, lies within the dataset, or holds it.
    """
    root = folder_of(dataset.path)
    target = checked_dest(dest, root)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}-", dir=target.parent) as scratch:
        folder = Path(scratch) / "gallery"
        for name in ("scenes", "pictures"):
            (folder / name).mkdir(parents=True)
        records = read_records(dataset)
        effort = usual_effort(len(records.done), renders, films)
        place = dataset.path.rstrip("/") if root is None else str(root)
        title = place.rpartition("/")[2] or "dataset"
        drawn = min(effort.renders, len(records.done))
        site = Site(folder, title, place, len(records.done), len(records.lost), drawn)
        cards = _scenes(site, records.done, effort, jobs, progress, robot)
        _overview(site, records, cards)
        write_mark(folder, f"tableverse-factory {__version__}", records.entered)
        put_in_place(folder, target, Path(scratch) / "replaced", str(dest))
    return dest.absolute() / "index.html"


def _scenes(
    site: Site,
    done: Sequence[SceneRecord],
    effort: GalleryOptions,
    jobs: int,
    progress: Callable[[int, int], None] | None,
    robot: str | None,
) -> list[Card]:
    """Writes the page of every scene."""
    ids = ["", *(scene.scene_id for scene in done), ""]
    orders = [
        Order(scene, place < effort.renders, ids[place], ids[place + 2], place // PAGE_SIZE + 1)
        for place, scene in enumerate(done)
    ]
    forget_datasets()
    work, cards = partial(write_scene, site, effort.films, robot), []
    for card in parallel_map(work, orders, jobs, "draws scenes", 1 if site.renders_all else _CHUNK):
        cards.append(card)
        if progress is not None:
            progress(len(cards), len(done))
    return cards


def default_dest(out: str) -> Path:
    """Beside the dataset: its own bytes stay as they were built."""
    path = Path(out.rstrip("/").rpartition("/")[2]) if "://" in out else Path(out).resolve()
    return path.with_name(f"{path.name}-gallery")


def _overview(site: Site, records: Records, cards: Sequence[Card]) -> None:
    """Writes everything but the scenes' own pages; index.html last."""
    for name in _STATIC:
        (site.folder / name).write_bytes(files("tableverse_factory.viz.gallery").joinpath("static", name).read_bytes())
    write_index(site.folder / NAME, records.done, cards, records.lost)
    lost = _dealt(records.lost, LOST_PAGE_SIZE)
    for number, scenes in enumerate(lost, 1):
        pager = {"page": number, "pages": len(lost), "names": [lost_name(n) for n in range(1, len(lost) + 1)]}
        site.write(lost_name(number), "lost.html", scenes=scenes, pager=pager)
    shown = _dealt(list(zip(records.done, cards, strict=True)), PAGE_SIZE) or [[]]
    names = [page_name(n) for n in range(1, len(shown) + 1)]
    reasons = records.reasons([code for card in cards for code in card.reason_codes])
    for number, items in reversed(list(enumerate(shown, 1))):
        pager = {"page": number, "pages": len(shown), "names": names}
        template, figures = ("index.html", _figures(records)) if number == 1 else ("page.html", {})
        site.write(
            names[number - 1], template, items=items, pager=pager, moves=records.moves, reasons=reasons, **figures
        )


def _figures(records: Records) -> dict[str, Any]:
    return {
        "records": records,
        "funnel": records.funnel(STAGES),
        "charts": charts(records),
        "n_objects": sum(len(scene.objects) for scene in records.done),
        "n_tasks": sum(scene.n_tasks for scene in records.done),
        "n_tried": sum(len(scene.trajectories) for scene in records.done),
        "n_succeeded": sum(scene.n_succeeded for scene in records.done),
    }


def _dealt(items: Sequence[Any], size: int) -> list[Sequence[Any]]:
    return [items[start : start + size] for start in range(0, len(items), size)]
