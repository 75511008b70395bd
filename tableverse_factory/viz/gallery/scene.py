"""One scene of a gallery: its pictures, its films and its page, made in one go wherever there is a core free."""

import shlex
from dataclasses import dataclass, replace
from functools import cache

from tableverse_factory.dataset.dataset import Dataset, open_dataset
from tableverse_factory.viz.gallery.motions import MotionCard, rows_only, write_motions
from tableverse_factory.viz.gallery.pages import Site
from tableverse_factory.viz.gallery.pictures import PictureSet, write_pictures
from tableverse_factory.viz.gallery.records import SceneFacts, SceneRecord, scene_facts


@dataclass(frozen=True, slots=True)
class Order:
    """What is asked for of a scene.

    Attributes:
        scene: Its rows.
        render: Whether its twin, its plots and its films are drawn.
        before: Id of the scene that comes before it; empty for the first.
        after: Id of the one that comes after it; empty for the last.
        page: Number of the page that shows its card.
    """

    scene: SceneRecord
    render: bool
    before: str
    after: str
    page: int


@dataclass(frozen=True, slots=True)
class Card:
    """What its card and the filters need of a scene; `problem` says why there are no pictures.

    Attributes:
        scene_id: Whose.
        pictures: Which there are.
        problem: Why there are none.
        reason_codes: Why the judge holds it to be unusable.
    """

    scene_id: str
    pictures: PictureSet | None
    problem: str = ""
    reason_codes: tuple[str, ...] = ()


def write_scene(site: Site, films: int, robot: str | None, order: Order) -> Card:
    """Draws a scene and writes its page; what keeps it from being drawn, or shown at all, is told there."""
    facts, pictures, motions, problem = _drawn(site, films, robot, order)
    card = Card(order.scene.scene_id, pictures, problem, facts.reason_codes)
    name = f"scenes/{card.scene_id}.html"
    listed = {"scene": order.scene, "order": order, "commands": commands(site.named, card.scene_id)}
    try:
        site.write(name, "scene.html", card=card, facts=facts, motions=motions, **listed)
    except Exception as error:  # noqa: BLE001 all other scenes of an hour's work are sound
        card = replace(card, problem=site.told(error))
        site.write(name, "unshown.html", card=card, **listed)
    return card


def _drawn(
    site: Site, films: int, robot: str | None, order: Order
) -> tuple[SceneFacts, PictureSet | None, tuple[MotionCard, ...], str]:
    folder = site.folder / "pictures"
    try:
        scene = _dataset(site.out).scene_at(order.scene.row)
        facts, pictures = scene_facts(scene.meta), write_pictures(scene, folder, order.render)
        if not order.render:
            return facts, pictures, rows_only(order.scene.trajectories), ""
        return facts, pictures, write_motions(scene, folder, films, robot), ""
    except Exception as error:  # noqa: BLE001 its files may be anybody's, and its page says what is wrong with them
        return SceneFacts(), None, (), site.told(error)


@cache
def _dataset(path: str) -> Dataset:
    return open_dataset(path)


def forget_datasets() -> None:
    """A gallery that is made later in the same process sees its dataset as it is then."""
    _dataset.cache_clear()


def commands(out: str, scene_id: str) -> tuple[tuple[str, str], ...]:
    """What to type to have the scene, each with what it does."""
    return (
        ("look at it in the browser, play its physics", f"tableverse view {shlex.quote(out)} {scene_id}"),
        ("take its files out", f"tableverse extract {shlex.quote(out)} {scene_id} scene/"),
        ("open them in MuJoCo's own viewer", "python -m mujoco.viewer --mjcf scene/scene.xml"),
        ("measure its certificate again", "tableverse verify scene/"),
    )
