"""Gallery of a dataset: a folder of HTML, CSS and JPEG that opens from disk, without network or server.

Its texts come from untrusted pictures, labels and models: templates escape everything, the script builds nodes from
text, and ids are checked before they become file names.
"""

import tempfile
from collections.abc import Callable, Sequence
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any

from tableverse_factory import pipeline
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.core.version import __version__
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.viz.destination import find_local_folder, replace_folder, resolve_destination, write_marker
from tableverse_factory.viz.funnel import compute_funnel
from tableverse_factory.viz.gallery.pages import Site, make_lost_name, make_page_name
from tableverse_factory.viz.gallery.records import Records, SceneRecord, make_charts, read_records
from tableverse_factory.viz.gallery.scene import SceneCard, SceneJob, close_datasets, write_scene
from tableverse_factory.viz.gallery.search_index import FILE_NAME, LOST_PAGE_SIZE, write_search_index

PAGE_SIZE = 24

DRAW_ALL_LIMIT, FILMS_PER_SCENE = 60, 6  # all scenes up to this number are drawn, some 4 CPU s each, a film 3
SAMPLE_SIZE = 6  # of more scenes

STAGES = ("manifest", "read_layout", *(stage.name for stage in pipeline.STAGES))  # stages of the funnel, in order

_STATIC = ("gallery.css", "gallery.js")
_CHUNK = 4  # scenes per task of a process when most are not drawn, which takes some hundredths of a second each


def choose_amounts(n_done: int, renders: int | None = None, films: int | None = None) -> tuple[int, int]:
    """Fill in how many scenes are drawn from every side, and films of each: all of few scenes, of many no films."""
    few = n_done <= DRAW_ALL_LIMIT
    if renders is None:
        renders = n_done if few else SAMPLE_SIZE
    if films is None:
        films = FILMS_PER_SCENE if few else 0
    return renders, films


def write_gallery(
    dataset: Dataset,
    dest: Path,
    jobs: int = 1,
    progress: Callable[[int, int], None] | None = None,
    renders: int | None = None,
    films: int | None = None,
    robot: str | None = None,
) -> Path:
    """Write the gallery of a dataset and return the path of its index.html.

    The dataset is only read; only committed shards are shown. `dest` may be new, empty, or an earlier gallery with
    nothing else in it, which is replaced once the new one is complete. The first `renders` scenes are drawn from every
    side, with at most `films` films each (defaults: `choose_amounts`); `progress` gets the numbers of drawn and of all
    scenes. `robot` is the arm of recordings of other robots than ours: a file, or `menagerie:NAME`.
    """
    root = find_local_folder(dataset.path)
    target = resolve_destination(dest, root)
    target.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{target.name}-", dir=target.parent) as scratch:
        folder = Path(scratch) / "gallery"
        for name in ("scenes", "pictures"):
            (folder / name).mkdir(parents=True)
        records = read_records(dataset)
        renders, films = choose_amounts(len(records.done), renders, films)
        address = dataset.path.rstrip("/") if root is None else str(root)
        title = address.rpartition("/")[2] or "dataset"
        drawn = min(renders, len(records.done))
        site = Site(folder, title, address, len(records.done), len(records.lost), drawn)
        cards = _write_scenes(site, records.done, films, jobs, progress, robot)
        _write_index_pages(site, records, cards)
        write_marker(folder, f"tableverse-factory {__version__}", records.entered)
        replace_folder(folder, target, Path(scratch) / "replaced", str(dest))
    return dest.absolute() / "index.html"


def _write_scenes(
    site: Site,
    done: Sequence[SceneRecord],
    films: int,
    jobs: int,
    progress: Callable[[int, int], None] | None,
    robot: str | None,
) -> list[SceneCard]:
    ids = ["", *(scene.scene_id for scene in done), ""]
    scene_jobs = [
        SceneJob(scene, position < site.n_rendered, ids[position], ids[position + 2], position // PAGE_SIZE + 1)
        for position, scene in enumerate(done)
    ]
    close_datasets()
    work, cards = partial(write_scene, site, films, robot), []
    for card in parallel_map(work, scene_jobs, jobs, "draws scenes", 1 if site.renders_all else _CHUNK):
        cards.append(card)
        if progress is not None:
            progress(len(cards), len(done))
    return cards


def _write_index_pages(site: Site, records: Records, cards: Sequence[SceneCard]) -> None:
    """Write everything but the pages of the scenes; index.html last."""
    for name in _STATIC:
        (site.folder / name).write_bytes(files("tableverse_factory.viz.gallery").joinpath("static", name).read_bytes())
    write_search_index(site.folder / FILE_NAME, records.done, cards, records.lost)
    lost = _split_pages(records.lost, LOST_PAGE_SIZE)
    for number, scenes in enumerate(lost, 1):
        pager = {"page": number, "pages": len(lost), "names": [make_lost_name(n) for n in range(1, len(lost) + 1)]}
        site.write(make_lost_name(number), "lost.html", scenes=scenes, pager=pager)
    shown = _split_pages(list(zip(records.done, cards, strict=True)), PAGE_SIZE) or [[]]
    names = [make_page_name(n) for n in range(1, len(shown) + 1)]
    reasons = records.count_reasons([code for card in cards for code in card.reason_codes])
    filtered = {"moves": records.has_trajectories, "reasons": reasons}
    for number, items in reversed(list(enumerate(shown, 1))):
        pager = {"page": number, "pages": len(shown), "names": names}
        template, figures = ("index.html", _summarize_records(records)) if number == 1 else ("page.html", {})
        site.write(names[number - 1], template, items=items, pager=pager, **filtered, **figures)


def _summarize_records(records: Records) -> dict[str, Any]:
    return {
        "records": records,
        "funnel": compute_funnel(records.entered, records.list_losses(), STAGES),
        "charts": make_charts(records),
        "n_objects": sum(len(scene.objects) for scene in records.done),
        "n_tasks": sum(scene.n_tasks for scene in records.done),
        "n_tried": sum(len(scene.trajectories) for scene in records.done),
        "n_succeeded": sum(scene.n_succeeded for scene in records.done),
    }


def _split_pages(items: Sequence[Any], size: int) -> list[Sequence[Any]]:
    return [items[start : start + size] for start in range(0, len(items), size)]
