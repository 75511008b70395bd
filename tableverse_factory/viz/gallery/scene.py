"""Page, pictures and films of one scene of a gallery, made in any process."""

import shlex
from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cache

from tableverse_factory.core.errors import BuildError
from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.viz.gallery.drawing import Drawing, DrawingOptions, draw_scene, name_drawing
from tableverse_factory.viz.gallery.motions import MotionCard, list_film_files, name_film
from tableverse_factory.viz.gallery.pages import Site, name_scene_page
from tableverse_factory.viz.gallery.pictures import PictureSet, list_possible_pictures
from tableverse_factory.viz.gallery.records import SceneFacts, SceneRecord


@dataclass(frozen=True, slots=True)
class Relative:
    """A scene of the same family, side by side with others on their pages."""

    scene_id: str
    title: str
    picture: str  # name of its small picture, without suffix
    changes: tuple[str, ...]  # of its parent


@dataclass(frozen=True, slots=True)
class SceneJob:
    """A scene to write."""

    scene: SceneRecord
    render: bool  # whether to draw its twin, plots and films
    before: str  # id of the previous scene; empty for the first
    after: str  # id of the next scene; empty for the last
    page: int
    family: tuple[Relative, ...] = ()  # of a cousin, itself included


@dataclass(frozen=True, slots=True)
class SceneCard:
    """Data of a scene for its card and the filters."""

    scene_id: str
    pictures: PictureSet | None  # None if they could not be made
    problem: str = ""  # why there are no pictures
    reason_codes: tuple[str, ...] = ()  # the judge's reasons why the scene is not usable
    files: tuple[str, ...] = ()  # of the scene in the gallery


def list_possible_files(scene: SceneRecord, render: bool) -> list[str]:
    """List all files that the gallery may have of a scene."""
    films = list_film_files(name_film(scene.scene_id, row["task_id"]) for row in scene.trajectories if render)
    pictures = [*list_possible_pictures(scene.scene_id, render), *films]
    return _list_files(scene.scene_id, pictures)


def _list_files(scene_id: str, pictures: Iterable[str]) -> list[str]:
    return [name_scene_page(scene_id), name_drawing(scene_id), *(f"pictures/{name}" for name in pictures)]


def make_card(scene_id: str, drawing: Drawing) -> SceneCard:
    """Make the card of a drawn scene."""
    files = tuple(_list_files(scene_id, drawing.files))
    return SceneCard(scene_id, drawing.pictures, "", drawing.facts.reason_codes, files)


def write_scene(site: Site, options: DrawingOptions, job: SceneJob) -> SceneCard:
    """Write the page of a scene, drawn now or before; the page states any problem with drawing or showing it."""
    scene_id, rows = job.scene.scene_id, job.scene.trajectories
    facts, motions, drawing = SceneFacts(), tuple(map(MotionCard, rows)), None
    try:
        scene = _open_dataset(site.out).scene_at(job.scene.row)
        drawing = draw_scene(scene, site.folder, options, job.render)
        facts, motions, card = drawing.facts, drawing.make_cards(rows), make_card(scene_id, drawing)
    except BuildError:  # the disk is full, say, for all scenes
        raise
    except Exception as error:  # noqa: BLE001 - its files are untrusted; its page states the error
        drawing, card = None, SceneCard(scene_id, None, site.describe_error(error), files=(name_scene_page(scene_id),))
    name, commands = name_scene_page(scene_id), list_commands(site.named, scene_id)
    listed = {"scene": job.scene, "job": job, "commands": commands}
    try:
        page = site.render(name, "scene.html", card=card, facts=facts, motions=motions, **listed)
    except Exception as error:  # noqa: BLE001 - a bad scene must not stop the others
        card = replace(card, problem=site.describe_error(error))
        page = site.render(name, "unshown.html", card=card, **listed)
    site.write_file(name, page)
    if drawing is not None:
        site.write_file(name_drawing(scene_id), drawing.encode())
    return card


@cache
def _open_dataset(path: str) -> Dataset:
    return open_dataset(path)


def close_datasets() -> None:
    """Close the cached datasets, so that a later gallery in this process reads them anew."""
    _open_dataset.cache_clear()


def list_commands(out: str, scene_id: str) -> tuple[tuple[str, str], ...]:
    """List commands for the scene with their descriptions."""
    return (
        ("view it in the browser, play its physics", f"tableverse view {shlex.quote(out)} {scene_id}"),
        ("extract its files", f"tableverse extract {shlex.quote(out)} scene --scene {scene_id}"),
        ("open them in the viewer of MuJoCo", "python -m mujoco.viewer --mjcf scene/scene.xml"),
        ("measure its certificate again", "tableverse verify scene/"),
    )
