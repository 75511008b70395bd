"""Drawings of scenes, kept in the gallery with hashes of what they depend on: a later report draws only what is new.

The file of a drawing is written after its pictures, and removed before they change.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from markupsafe import Markup
from pydantic import TypeAdapter

from schemas.config import Config
from schemas.identity import content_hash
from tableverse_factory.core.storage.files import remove
from tableverse_factory.dataset.dataset import Scene
from tableverse_factory.robotics.robots.recorded import record_robot
from tableverse_factory.run_record import collect_versions
from tableverse_factory.viz.gallery.motions import MotionCard, list_film_files, write_motions
from tableverse_factory.viz.gallery.pictures import PictureSet, write_pictures
from tableverse_factory.viz.gallery.records import Row, SceneFacts, read_scene_facts


@dataclass(frozen=True, slots=True)
class DrawingOptions:
    """Options of a gallery that its pictures and films depend on."""

    films: int  # most films of a scene
    robot: str | None  # arm of recordings of other robots than ours: a file or a name
    arm: str | None  # hash of that file and those it names, or that name
    code: str  # hash of this program and the packages that decide bytes

    def hash(self, render: bool) -> str:
        """Hash the options of a scene that is rendered, or is not."""
        return content_hash(json.dumps([self.code, [self.films, self.arm] if render else None]).encode())


def make_options(films: int, robot: str | None) -> DrawingOptions:
    """Make the options, with the hash of code and robot as they are now."""
    files = record_robot(Config.model_validate({"trajectories": {"robot": robot}}), {}) if robot else None
    arm = files["sha256"] if files else robot
    return DrawingOptions(films, robot, arm, content_hash(json.dumps(collect_versions()).encode()))


@dataclass(frozen=True, slots=True)
class Drawing:
    """Pictures, films and plots of a scene, and what of its meta.json is on its page."""

    options: str  # hash of the options that it was drawn with
    content: str  # hash of the scene's files, and of its rows of trajectories/ if it is rendered
    facts: SceneFacts
    pictures: PictureSet
    motions: tuple[tuple[str, str, str], ...]  # film, plot and problem of each trajectory; none if it is not rendered

    @property
    def files(self) -> tuple[str, ...]:
        """Names in the folder `pictures`."""
        return (*self.pictures.files, *list_film_files(film for film, _, _ in self.motions if film))

    def make_cards(self, rows: Sequence[Row]) -> tuple[MotionCard, ...]:
        """Make the cards of the scene's trajectories."""
        if not self.motions:
            return tuple(map(MotionCard, rows))
        return tuple(
            MotionCard(row, film, Markup(plot) if plot else None, problem)  # noqa: S704 `plot_svg` escapes its texts
            for row, (film, plot, problem) in zip(rows, self.motions, strict=True)
        )

    def encode(self) -> bytes:
        """Encode as JSON."""
        return json.dumps(asdict(self), sort_keys=True).encode()


_DRAWING = TypeAdapter(Drawing)


def name_drawing(scene_id: str) -> str:
    """Name the file of a scene's drawing in the gallery."""
    return f"drawn/{scene_id}.json"


def load_drawing(gallery: Path, scene_id: str) -> Drawing | None:
    """Load what was drawn of a scene; None if there is nothing, or any of its files is missing or damaged."""
    try:
        drawing = _DRAWING.validate_python(json.loads((gallery / name_drawing(scene_id)).read_bytes()))
    except (FileNotFoundError, ValueError, RecursionError):
        return None
    return drawing if all((gallery / "pictures" / name).is_file() for name in drawing.files) else None


def draw_scene(scene: Scene, gallery: Path, options: DrawingOptions, render: bool) -> Drawing:
    """Draw a scene, or return what was drawn of it before; `render` draws it from every side, with plots and films."""
    hashes, folder = (options.hash(render), _hash_content(scene, render)), gallery / "pictures"
    known = load_drawing(gallery, scene.scene_id)
    if known is not None and (known.options, known.content) == hashes:
        return known
    remove(gallery / name_drawing(scene.scene_id))
    facts, pictures = read_scene_facts(scene.meta), write_pictures(scene, folder, render)
    motions = write_motions(scene, folder, options.films, options.robot) if render else ()
    return Drawing(*hashes, facts, pictures, tuple((card.film, card.plot or "", card.problem) for card in motions))


def _hash_content(scene: Scene, render: bool) -> str:
    files, rows = scene.files(), scene.trajectory_rows() if render else []
    parts = (part for name in sorted(files) for part in (name.encode(), files[name]))
    return content_hash(json.dumps(rows).encode(), *parts)
