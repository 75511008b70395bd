"""Page, pictures and films of one scene of a gallery, made in any process."""

import shlex
from dataclasses import dataclass, replace
from functools import cache

from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.viz.gallery.motions import MotionCard, write_motions
from tableverse_factory.viz.gallery.pages import Site
from tableverse_factory.viz.gallery.pictures import PictureSet, write_pictures
from tableverse_factory.viz.gallery.records import SceneFacts, SceneRecord, read_scene_facts


@dataclass(frozen=True, slots=True)
class SceneJob:
    """A scene to write."""

    scene: SceneRecord
    render: bool  # whether to draw its twin, plots and films
    before: str  # id of the previous scene; empty for the first
    after: str  # id of the next scene; empty for the last
    page: int


@dataclass(frozen=True, slots=True)
class SceneCard:
    """Data of a scene for its card and the filters."""

    scene_id: str
    pictures: PictureSet | None  # None if they could not be made
    problem: str = ""  # why there are no pictures
    reason_codes: tuple[str, ...] = ()  # the judge's reasons why the scene is not usable


def write_scene(site: Site, films: int, robot: str | None, job: SceneJob) -> SceneCard:
    """Draw a scene and write its page, which states any problem with drawing or showing it."""
    facts, pictures, motions, problem = _draw_scene(site, films, robot, job)
    card = SceneCard(job.scene.scene_id, pictures, problem, facts.reason_codes)
    name = f"scenes/{card.scene_id}.html"
    listed = {"scene": job.scene, "job": job, "commands": list_commands(site.named, card.scene_id)}
    try:
        site.write(name, "scene.html", card=card, facts=facts, motions=motions, **listed)
    except Exception as error:  # noqa: BLE001 - a bad scene must not stop the others
        card = replace(card, problem=site.describe_error(error))
        site.write(name, "unshown.html", card=card, **listed)
    return card


def _draw_scene(
    site: Site, films: int, robot: str | None, job: SceneJob
) -> tuple[SceneFacts, PictureSet | None, tuple[MotionCard, ...], str]:
    folder, motions = site.folder / "pictures", tuple(map(MotionCard, job.scene.trajectories))
    try:
        scene = _open_dataset(site.out).scene_at(job.scene.row)
        facts, pictures = read_scene_facts(scene.meta), write_pictures(scene, folder, job.render)
        return facts, pictures, write_motions(scene, folder, films, robot) if job.render else motions, ""
    except Exception as error:  # noqa: BLE001 - its files are untrusted; its page states the error
        return SceneFacts(), None, (), site.describe_error(error)


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
        ("extract its files", f"tableverse extract {shlex.quote(out)} {scene_id} scene/"),
        ("open them in the viewer of MuJoCo", "python -m mujoco.viewer --mjcf scene/scene.xml"),
        ("measure its certificate again", "tableverse verify scene/"),
    )
