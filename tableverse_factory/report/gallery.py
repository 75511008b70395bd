"""The gallery: one folder of HTML, CSS and JPEG that opens from disk, with no network and no server.

Every text in it comes from pictures, labels and models that nobody vouches for: templates escape everything, the
script builds its nodes from text, and ids are checked before they become names of files.
"""

import json
import shlex
import shutil
import tempfile
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from functools import partial
from importlib.resources import files
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from threadpoolctl import threadpool_limits

from tableverse_factory import __version__, pipeline
from tableverse_factory.dataset import Dataset, open_dataset
from tableverse_factory.errors import InputError
from tableverse_factory.report.motions import Motion, write_motions
from tableverse_factory.report.pictures import PictureSet, write_pictures
from tableverse_factory.report.records import Records, SceneFacts, SceneRecord, charts, read_records, scene_facts
from tableverse_factory.report.words import FILTERS

PAGE_SIZE = 24
LOST_PAGE_SIZE = 100
FILMS = 6
"""Per scene, by default: a film takes some three seconds, and a scene may have twenty trajectories."""

STAGES = ("manifest", "read_layout", *(stage.name for stage in pipeline.STAGES))
"""In the order in which they lose scenes."""

_MARK = "tableverse-gallery.json"
_STATIC = ("gallery.css", "gallery.js")


@dataclass(frozen=True, slots=True)
class Drawn:
    """What could be read and drawn of a scene; `problem` says why there are no pictures."""

    facts: SceneFacts
    pictures: PictureSet | None
    problem: str
    motions: tuple[Motion, ...] = ()


@dataclass(frozen=True, slots=True)
class Card:
    """A done scene with its pictures; `problem` says why there are none."""

    scene: SceneRecord
    pictures: PictureSet | None
    problem: str = ""


def write_gallery(
    dataset: Dataset,
    dest: Path,
    jobs: int = 1,
    progress: Callable[[int, int], None] | None = None,
    films: int = FILMS,
    robot: str | None = None,
) -> Path:
    """Writes the gallery of a dataset and returns the path of its index.html.

    The dataset is only read. `dest` may be new, empty, or an earlier gallery, which is replaced when the new one is
    complete.

    Args:
        dataset: Finished or not; only committed shards are shown.
        dest: The folder.
        jobs: Processes that draw.
        progress: Called with the number of scenes drawn and of all.
        films: At most so many per scene.
        robot: The arm of recordings whose robot is none of ours: a file, or `menagerie:NAME`.

    Raises:
        InputError: if `dest` holds something else, or lies within the dataset.
    """
    _check_dest(dataset, dest)
    dest = dest.absolute()
    dest.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{dest.name}-", dir=dest.parent) as scratch:
        finished = _write(dataset, Path(scratch) / "gallery", jobs, progress, films, robot)
        if dest.exists():
            shutil.rmtree(dest)
        finished.rename(dest)
    return dest / "index.html"


def _write(
    dataset: Dataset,
    dest: Path,
    jobs: int,
    progress: Callable[[int, int], None] | None,
    films: int,
    robot: str | None,
) -> Path:
    for folder in ("scenes", "pictures"):
        (dest / folder).mkdir(parents=True)
    records = read_records(dataset, PAGE_SIZE)
    site = _Site(dest, dataset, records)
    draw = partial(draw_scene, dataset.path, dest / "pictures", films=films, robot=robot)
    drawing, cards = _drawn(draw, [scene.scene_id for scene in records.done], jobs), []
    for scene, drawn in zip(records.done, drawing, strict=True):
        cards.append(site.add(scene, drawn))
        if progress is not None:
            progress(len(cards), len(records.done))
    site.write(cards)
    return dest


def _drawn(draw: Callable[[str], Drawn], ids: Sequence[str], jobs: int) -> Iterator[Drawn]:
    """What was drawn of each scene, in order."""
    if jobs <= 1 or len(ids) < 2:
        yield from map(draw, ids)
        return
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        try:
            yield from pool.map(draw, ids)
        except BrokenProcessPool as error:
            raise InputError("a process that draws scenes died: its memory ran out, or a scene crashed it") from error


def draw_scene(path: str, folder: Path, scene_id: str, films: int = FILMS, robot: str | None = None) -> Drawn:
    """Opens a scene and writes its pictures and films; what keeps it from it is part of the answer."""
    try:
        with threadpool_limits(1):
            scene = open_dataset(path).scene(scene_id)
            facts, pictures = scene_facts(scene.meta), write_pictures(scene, folder)
            return Drawn(facts, pictures, "", write_motions(scene, folder, films, robot))
    except (InputError, ValueError) as error:
        return Drawn(SceneFacts(), None, str(error)[:500])


def default_dest(out: str) -> Path:
    """Beside the dataset: its own bytes stay as they were built."""
    path = Path(out.rstrip("/").rpartition("/")[2]) if "://" in out else Path(out).resolve()
    return path.with_name(f"{path.name}-gallery")


def _check_dest(dataset: Dataset, dest: Path) -> None:
    if dest.exists() and not dest.is_dir():
        raise InputError(f"{dest}: a file; give a new or an empty folder")
    if dest.exists() and any(dest.iterdir()) and not (dest / _MARK).is_file():
        raise InputError(f"{dest}: holds something that is no gallery; give a new or an empty folder")
    root = Path(dataset.path).resolve()
    if root == dest.resolve() or root in dest.resolve().parents:
        raise InputError(f"{dest}: lies within the dataset, whose bytes stay as they were built; give another folder")


class _Site:
    """The pages of one gallery."""

    def __init__(self, folder: Path, dataset: Dataset, records: Records) -> None:
        self._folder = folder
        self._dataset = dataset
        self._records = records
        self._templates = Environment(
            loader=PackageLoader("tableverse_factory.report"),
            autoescape=True,
            undefined=StrictUndefined,
            trim_blocks=True,
            lstrip_blocks=True,
        )
        self._templates.filters.update(FILTERS)

    def add(self, scene: SceneRecord, drawn: Drawn) -> Card:
        """Writes a scene's page; a scene that does not open says so on it."""
        card = Card(scene, drawn.pictures, drawn.problem)
        self._page(
            f"scenes/{scene.scene_id}.html",
            "scene.html",
            root="../",
            card=card,
            facts=drawn.facts,
            motions=drawn.motions,
            commands=_commands(self._dataset.path, scene.scene_id),
        )
        return card

    def write(self, cards: Sequence[Card]) -> None:
        """Writes everything but the scenes' own pages; index.html last."""
        for name in _STATIC:
            (self._folder / name).write_bytes(files("tableverse_factory.report").joinpath("static", name).read_bytes())
        (self._folder / "search.js").write_text(_search_script(cards, self._records.lost), encoding="utf-8")
        lost = _pages(self._records.lost, LOST_PAGE_SIZE)
        for number, scenes in enumerate(lost, 1):
            pager = {"page": number, "pages": len(lost), "names": [_lost_name(n) for n in range(1, len(lost) + 1)]}
            self._page(_lost_name(number), "lost.html", root="", scenes=scenes, pager=pager)
        pages = _pages(cards, PAGE_SIZE) or [[]]
        names = [_page_name(n) for n in range(1, len(pages) + 1)]
        for number, shown in reversed(list(enumerate(pages, 1))):
            pager = {"page": number, "pages": len(pages), "names": names}
            template, overview = ("index.html", self._overview()) if number == 1 else ("page.html", {})
            self._page(names[number - 1], template, root="", cards=shown, pager=pager, **overview)
        mark = {"made_by": f"tableverse-factory {__version__}", "scenes": self._records.entered}
        (self._folder / _MARK).write_text(json.dumps(mark) + "\n", encoding="utf-8")

    def _overview(self) -> dict[str, Any]:
        records = self._records
        return {
            "funnel": records.funnel(STAGES),
            "charts": charts(records),
            "n_objects": sum(len(scene.objects) for scene in records.done),
            "n_tasks": sum(bool(task["accepted"]) for scene in records.done for task in scene.tasks),
            "n_tried": sum(len(scene.trajectories) for scene in records.done),
            "n_succeeded": sum(scene.n_succeeded for scene in records.done),
        }

    def _page(self, name: str, template: str, **context: Any) -> None:
        title = Path(self._dataset.path.rstrip("/")).name or "dataset"
        html = self._templates.get_template(template).render(
            dataset=title, records=self._records, version=__version__, lost_name=_lost_name(1), **context
        )
        (self._folder / name).write_text(html, encoding="utf-8")


def _commands(out: str, scene_id: str) -> tuple[str, ...]:
    return (
        f"tableverse extract {shlex.quote(out)} {scene_id} scene/",
        "python -m mujoco.viewer --mjcf scene/scene.xml",
    )


def _search_script(cards: Sequence[Card], lost: Sequence[SceneRecord]) -> str:
    """What the filter searches, as a script: a page opened from disk may not fetch JSON. Every `<` is escaped."""
    entries = [
        {
            "id": card.scene.scene_id,
            "title": card.scene.title,
            "status": "done",
            "score": card.scene.row["quality_score"],
            "usable": card.scene.row["usable"],
            "text": " ".join(card.scene.names),
            "tried": len(card.scene.trajectories),
            "succeeded": card.scene.n_succeeded,
            "picture": (card.pictures.photo or card.pictures.front) if card.pictures else "",
            "twin": (card.pictures.twin or card.pictures.top) if card.pictures else "",
        }
        for card in cards
    ]
    entries += [
        {
            "id": scene.scene_id,
            "title": scene.title,
            "status": scene.row["status"],
            "text": scene.why,
            "page": _lost_name(number // LOST_PAGE_SIZE + 1),
        }
        for number, scene in enumerate(lost)
    ]
    return f"window.TABLEVERSE = {json.dumps(entries, separators=(',', ':'))};\n".replace("<", "\\u003c")


def _pages(items: Sequence[Any], size: int) -> list[Sequence[Any]]:
    return [items[start : start + size] for start in range(0, len(items), size)]


def _page_name(number: int) -> str:
    return "index.html" if number == 1 else f"page-{number:04d}.html"


def _lost_name(number: int) -> str:
    return "lost.html" if number == 1 else f"lost-{number:04d}.html"
