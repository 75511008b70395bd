"""Search data of the filters: a script of plain data, since a page opened from disk may not fetch JSON.

Twenty thousand scenes take some two megabytes, which a page loads at the first use of a filter.
"""

import json
from collections import Counter
from collections.abc import Sequence
from typing import Any

from tableverse_factory.viz.gallery.pages import make_lost_name
from tableverse_factory.viz.gallery.records import SceneRecord
from tableverse_factory.viz.gallery.scene import SceneCard

FILE_NAME = "scenes.js"
LOST_PAGE_SIZE = 100
MOST_LABELS = 500  # most labels that the filter lists; typing finds the others


def encode_search_index(drawn: Sequence[tuple[SceneRecord, SceneCard]], lost: Sequence[SceneRecord]) -> bytes:
    """Encode the data, without markup: `<` and all but ASCII are escaped."""
    names = Counter(name for scene, _ in drawn for name in set(scene.labels))
    labels = sorted(names, key=lambda name: (-names[name], name))
    number = {name: index for index, name in enumerate(labels)}
    pages = [make_lost_name(position // LOST_PAGE_SIZE + 1) for position in range(len(lost))]
    index = {
        "labels": labels,
        "offered": min(MOST_LABELS, len(labels)),
        "done": [_encode_done(scene, card, number) for scene, card in drawn],
        "lost": [
            [scene.scene_id, _encode_title(scene), str(scene.row["status"]), scene.reason, page]
            for scene, page in zip(lost, pages, strict=True)
        ],
    }
    text = json.dumps(index, separators=(",", ":"), ensure_ascii=True, allow_nan=False)
    return f"window.TABLEVERSE = {text};\n".replace("<", "\\u003c").encode("ascii")


def _encode_done(scene: SceneRecord, card: SceneCard, number: dict[str, int]) -> list[Any]:
    """Encode a scene in the order of fields that `gallery.js` reads."""
    row = scene.row
    return [
        scene.scene_id,
        _encode_title(scene),
        row["quality_score"],
        0 if row["usable"] is False else 1,
        [*card.reason_codes, *scene.losses],
        _to_micrometres(scene.penetration_m),
        _to_micrometres(row["drift_m"]),
        sorted(number[name] for name in set(scene.labels)),
        len(scene.objects),
        scene.n_tasks,
        scene.n_succeeded,
        len(scene.trajectories),
        [caption for _, caption in card.pictures.thumbs] if card.pictures else [],
        row["scale_source"] or "",
    ]


def _encode_title(scene: SceneRecord) -> str | int:
    return 0 if scene.title == scene.scene_id else scene.title


def _to_micrometres(metres: float | None) -> float | None:
    return None if metres is None or not abs(metres) < 1e3 else round(1e6 * metres, 1)
