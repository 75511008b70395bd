"""Gallery of a dataset: a folder of HTML, CSS and JPEG that opens from disk, without network or server.

Its texts come from untrusted pictures, labels and models: templates escape everything, the script builds nodes from
text, and ids are checked before they become file names.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from importlib import resources
from pathlib import Path
from typing import Any

from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.dataset.dataset import Dataset
from tableverse_factory.viz.destination import (
    check_gallery,
    find_local_folder,
    lock_gallery,
    remove_leftovers,
    resolve_destination,
    write_marker,
)
from tableverse_factory.viz.funnel import compute_funnel
from tableverse_factory.viz.gallery.drawing import DrawingOptions, load_drawing, make_options
from tableverse_factory.viz.gallery.pages import Site, make_lost_name, make_page_name
from tableverse_factory.viz.gallery.pictures import name_pictures
from tableverse_factory.viz.gallery.records import Records, SceneRecord, make_charts, read_records
from tableverse_factory.viz.gallery.scene import (
    Relative,
    SceneCard,
    SceneJob,
    close_datasets,
    list_possible_files,
    make_card,
    write_scene,
)
from tableverse_factory.viz.gallery.search_index import FILE_NAME, LOST_PAGE_SIZE, encode_search_index

PAGE_SIZE = 24

DRAW_ALL_LIMIT, FILMS_PER_SCENE = 60, 6  # all scenes up to this number are drawn, some 4 CPU s each, a film 3
SAMPLE_SIZE = 6  # of more scenes
MOST_RELATIVES = 24  # of a family on the page of each of its scenes

_STATIC = ("gallery.css", "gallery.js")
_RENEWAL_S = 10.0  # least time between two indexes of what is drawn so far
_KEPT_PER_PROCESS = 100  # scenes already drawn, which are read and hashed in some hundredths of a second each
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

    The dataset is only read. `dest` may be new, empty, or an earlier gallery of this dataset with nothing else in it,
    finished or not: only scenes that are new or differ are drawn, and files of others are removed at the end. The first
    `renders` scenes are drawn from every side, with at most `films` films each (defaults: `choose_amounts`); `progress`
    gets the numbers of finished and of all scenes. `robot` is the arm of recordings of other robots than ours: a file,
    or `menagerie:NAME`.
    """
    root = find_local_folder(dataset.path)
    folder = resolve_destination(dest, root)
    records = read_records(dataset)
    renders, films = choose_amounts(len(records.done), renders, films)
    address = dataset.path.rstrip("/") if root is None else str(root)
    title = address.rpartition("/")[2] or "dataset"
    site = Site(folder, title, address, len(records.done), len(records.lost), min(renders, len(records.done)))
    scene_jobs, options, pages = _list_jobs(site, records.done), make_options(films, robot), _list_page_names(records)
    with lock_gallery(folder, site.named, str(dest)) as earlier:
        possible = earlier.union(pages, *(list_possible_files(job.scene, job.render) for job in scene_jobs))
        write_marker(folder, site.named, records.entered, possible)
        cards = _draw_scenes(site, records, scene_jobs, options, jobs, progress)
        check_gallery(folder, site.named, str(dest))
        files = pages.union(*(card.files for card in cards))
        remove_leftovers(folder, possible, keep=files)
        write_marker(folder, site.named, records.entered, files)
    return dest.absolute() / "index.html"


def _list_jobs(site: Site, done: Sequence[SceneRecord]) -> list[SceneJob]:
    ids = ["", *(scene.scene_id for scene in done), ""]
    families = _list_families(site, done)
    return [
        SceneJob(
            scene,
            position < site.n_rendered,
            ids[position],
            ids[position + 2],
            position // PAGE_SIZE + 1,
            families.get(scene.row["family"] or "", ()),
        )
        for position, scene in enumerate(done)
    ]


def _list_families(site: Site, done: Sequence[SceneRecord]) -> dict[str, tuple[Relative, ...]]:
    """List the cousins of each family that has any, in the order of the dataset, at most `MOST_RELATIVES`."""
    families: dict[str, tuple[Relative, ...]] = {}
    for position, scene in enumerate(done):
        known = families.get(scene.row["family"] or "", ())
        if scene.row["parent"] is not None and len(known) < MOST_RELATIVES:
            kind = "front" if position < site.n_rendered else "sketch"
            picture = name_pictures(scene.scene_id, [kind])[kind]
            its = Relative(scene.scene_id, scene.title, picture, tuple(scene.row["changes"] or ()))
            families[scene.row["family"]] = (*known, its)
    return families


def _draw_scenes(
    site: Site,
    records: Records,
    scene_jobs: Sequence[SceneJob],
    options: DrawingOptions,
    jobs: int,
    progress: Callable[[int, int], None] | None,
) -> list[SceneCard]:
    """Write everything, with an index of what is drawn so far meanwhile."""
    cards, n_new = {}, 0
    for job in scene_jobs:
        drawing = load_drawing(site.folder, job.scene.scene_id)
        if drawing is not None:
            cards[job.scene.scene_id] = make_card(job.scene.scene_id, drawing)
        n_new += drawing is None or drawing.options != options.hash(job.render)
    processes = min(jobs, n_new + len(scene_jobs) // _KEPT_PER_PROCESS)
    renewal = _write_index_pages(site, records, cards)
    close_datasets()
    work, chunk = partial(write_scene, site, options), 1 if site.renders_all else _CHUNK
    try:
        for count, card in enumerate(parallel_map(work, scene_jobs, processes, "draws scenes", chunk), 1):
            cards[card.scene_id] = card
            if progress is not None:
                progress(count, len(scene_jobs))
            if time.monotonic() >= renewal:
                renewal = _write_index_pages(site, records, cards)
    finally:  # also where Ctrl-C stops it
        _write_index_pages(site, records, cards)
    return list(cards.values())


def _list_page_names(records: Records) -> frozenset[str]:
    """List the files of a gallery that are not of one scene."""
    shown, lost = _split_pages(records.done, PAGE_SIZE) or [[]], _split_pages(records.lost, LOST_PAGE_SIZE)
    return frozenset((*_STATIC, FILE_NAME, *_list_names(make_page_name, shown), *_list_names(make_lost_name, lost)))


def _list_names(make_name: Callable[[int], str], pages: Sequence[object]) -> list[str]:
    return [make_name(number) for number in range(1, len(pages) + 1)]


def _write_index_pages(site: Site, records: Records, cards: Mapping[str, SceneCard]) -> float:
    """Write everything but the pages of the scenes, index.html last; return when to renew it (`time.monotonic`)."""
    started = time.monotonic()
    static = resources.files("tableverse_factory.viz.gallery") / "static"
    for name in _STATIC:
        site.write_file(name, (static / name).read_bytes())
    drawn = [(scene, cards[scene.scene_id]) for scene in records.done if scene.scene_id in cards]
    site.write_file(FILE_NAME, encode_search_index(drawn, records.lost))
    lost = _split_pages(records.lost, LOST_PAGE_SIZE)
    names = _list_names(make_lost_name, lost)
    for number, scenes in enumerate(lost, 1):
        pager = {"page": number, "pages": len(lost), "names": names}
        site.write(names[number - 1], "lost.html", scenes=scenes, pager=pager)
    shown = _split_pages(drawn, PAGE_SIZE) or [[]]
    names = _list_names(make_page_name, shown)
    reasons = records.count_reasons([code for scene, card in drawn for code in (*card.reason_codes, *scene.losses)])
    filtered = {"moves": records.has_trajectories, "reasons": reasons, "scales": records.list_scale_sources()}
    for number, items in reversed(list(enumerate(shown, 1))):
        pager = {"page": number, "pages": len(shown), "names": names}
        template, figures = ("index.html", _summarize_records(records)) if number == 1 else ("page.html", {})
        site.write(names[number - 1], template, items=items, n_drawn=len(drawn), pager=pager, **filtered, **figures)
    now = time.monotonic()
    return now + max(_RENEWAL_S, 20 * (now - started))


def _summarize_records(records: Records) -> dict[str, Any]:
    return {
        "records": records,
        "funnel": compute_funnel(records.entered, records.list_losses(), records.kinds),
        "charts": make_charts(records),
        "n_objects": sum(len(scene.objects) for scene in records.done),
        "n_tasks": sum(scene.n_tasks for scene in records.done),
        "n_tried": sum(len(scene.trajectories) for scene in records.done),
        "n_succeeded": sum(scene.n_succeeded for scene in records.done),
    }


def _split_pages(items: Sequence[Any], size: int) -> list[Sequence[Any]]:
    return [items[start : start + size] for start in range(0, len(items), size)]
