"""What the filters search: one small script of plain data, since a page opened from disk may not fetch JSON.

Twenty thousand scenes take some two megabytes. A page asks for it when somebody first uses a filter.
"""

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tableverse_factory.viz.gallery.pages import lost_name
from tableverse_factory.viz.gallery.records import SceneRecord
from tableverse_factory.viz.gallery.scene import Card

NAME = "scenes.js"
LOST_PAGE_SIZE = 100
MOST_LABELS = 500
"""That are offered in the list; typing finds the others."""


def write_index(path: Path, done: Sequence[SceneRecord], cards: Sequence[Card], lost: Sequence[SceneRecord]) -> None:
    """Writes the data. Nothing in it is markup: every `<` is escaped, and so is all that is not ASCII.

    Args:
        path: Of the file.
        done: Scenes with a page.
        cards: One for each of these.
        lost: Scenes without.
    """
    names = Counter(name for scene in done for name in set(scene.labels))
    labels = sorted(names, key=lambda name: (-names[name], name))
    number = {name: index for index, name in enumerate(labels)}
    index = {
        "labels": labels,
        "offered": min(MOST_LABELS, len(labels)),
        "done": [_done(scene, card, number) for scene, card in zip(done, cards, strict=True)],
        "lost": [_lost(scene, lost_name(place // LOST_PAGE_SIZE + 1)) for place, scene in enumerate(lost)],
    }
    text = json.dumps(index, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    path.write_text(f"window.TABLEVERSE = {text};\n".replace("<", "\\u003c"), encoding="ascii")


def _done(scene: SceneRecord, card: Card, number: dict[str, int]) -> list[Any]:
    """As `gallery.js` reads it: the order is the contract."""
    row = scene.row
    return [
        scene.scene_id,
        0 if scene.title == scene.scene_id else scene.title,
        row["quality_score"],
        0 if row["usable"] is False else 1,
        list(card.reason_codes),
        _micrometres(scene.penetration_m),
        _micrometres(row["drift_m"]),
        sorted(number[name] for name in set(scene.labels)),
        len(scene.objects),
        scene.n_tasks,
        scene.n_succeeded,
        len(scene.trajectories),
        [caption for _, caption in card.pictures.thumbs] if card.pictures else [],
    ]


def _lost(scene: SceneRecord, page: str) -> list[Any]:
    title = 0 if scene.title == scene.scene_id else scene.title
    return [scene.scene_id, title, str(scene.row["status"]), scene.why, page]


def _micrometres(metres: float | None) -> float | None:
    return None if metres is None or not abs(metres) < 1e3 else round(1e6 * metres, 1)
