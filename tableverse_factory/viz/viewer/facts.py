"""What is known of a scene, as HTML for the panel. Every text from the dataset is cut and escaped here."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from tableverse_factory.core.text import sanitize_line
from tableverse_factory.viz.gallery.words import DASH, degrees, explained, mass, millimetres

MAX_ROWS = 100
"""Objects and tasks beyond are only counted."""

_STYLE = "font-size:0.8rem;line-height:1.35;padding:0.25rem 0.75rem;overflow-wrap:anywhere"
_HEADING = "font-size:0.85rem;margin:0.7rem 0 0.2rem"
OURS = "tableverse"
"""Class of what we add to viser's page."""

_CERTIFICATE = (
    ("deepest overlap of pieces", "piece_penetration_m", millimetres),
    ("before settling", "piece_penetration_before_m", millimetres),
    ("deepest overlap of meshes", "mesh_penetration_m", millimetres),
    ("drift in 5 s", "drift_m", millimetres),
    ("turned in 5 s", "drift_rad", degrees),
)

Row = Mapping[str, Any]


def safe(value: object, limit: int = 120) -> str:
    """Any text as HTML shows it: one line, cut, escaped."""
    return escape(sanitize_line(str(value), limit), quote=True)


def photograph_html(jpeg: bytes | None) -> str:
    """The photograph, or that there is none."""
    if jpeg is None:
        return _box("<p>No photograph: this scene was made from a layout.</p>", "Photograph")
    data = base64.b64encode(jpeg).decode()
    picture = f'<img alt="The photograph that this scene was made from" src="data:image/jpeg;base64,{data}" '
    return _box(picture + 'style="width:100%;border-radius:4px;display:block">', "Photograph")


def lost_html(row: Row) -> str:
    """Why a scene has no files."""
    why = str(row.get("reason") or row.get("error_kind") or "")
    told = explained(why)
    lines = [
        f"<b>{safe(row.get('status'))}</b> at {safe(row.get('stage'))}: {safe(why.replace('_', ' '))}",
        safe(told) if told else "",
        safe(row.get("detail") or "", 500),
    ]
    return _box(_title(row) + "".join(f"<p>{line}</p>" for line in lines if line), "Facts")


def facts_html(row: Row, meta: Row, objects: Sequence[Row], tasks: Sequence[Row], link: str) -> str:
    """Certificate, objects with their masses, tasks.

    Args:
        row: Of scenes/; empty for a scene that lies in no dataset.
        meta: Its meta.json.
        objects: Rows of objects/, or what stands for them.
        tasks: Rows of tasks/.
        link: Address of this scene; empty where there is no other.
    """
    certificate = meta.get("certificate")
    figures = certificate if isinstance(certificate, Mapping) else row
    lines = [(name, write(_number(figures.get(key)))) for name, key, write in _CERTIFICATE]
    kept = [(name, text) for name, text in lines if text != DASH]
    source = [(name, safe(row[name])) for name in ("source", "licence") if row.get(name)]
    score = [("quality", f"{safe(row['quality_score'])} of 10")] if row.get("quality_score") is not None else []
    parts = [_table("Certificate", kept), _table("Scene", [*score, *source]), _objects(objects), _tasks(tasks)]
    if link:
        parts.append(f'<p><a href="{escape(link, quote=True)}">Link to this scene</a></p>')
    return _box(_title(row) + "".join(parts), "Facts")


def _title(row: Row) -> str:
    """The scene's own name, where it has one."""
    name = row.get("name") or row.get("scene_id") or "Scene"
    return f'<h1 style="font-size:1rem;margin:0.4rem 0">{safe(name, 80)}</h1>'


def _objects(rows: Sequence[Row]) -> str:
    lines = [
        (safe(row.get("relabel_name") or row.get("label") or row["object_id"], 60), mass(_number(row.get("mass_kg"))))
        for row in rows[:MAX_ROWS]
    ]
    return _table(f"Objects ({len(rows)})", lines)


def _tasks(rows: Sequence[Row]) -> str:
    accepted = [row for row in rows if row.get("accepted")]
    lines = "".join(f"<li>{safe(row.get('instruction') or '', 200)}</li>" for row in accepted[:MAX_ROWS])
    return f'<h2 style="{_HEADING}">Tasks ({len(accepted)})</h2><ol>{lines}</ol>' if accepted else ""


def _table(title: str, lines: Sequence[tuple[str, str]]) -> str:
    """A title with names and values, which are HTML already."""
    if not lines:
        return ""
    rows = "".join(
        f'<tr><th scope="row" style="text-align:left;font-weight:400">{name}</th>'
        f'<td style="text-align:right">{text}</td></tr>'
        for name, text in lines
    )
    return f'<h2 style="{_HEADING}">{title}</h2><table style="width:100%">{rows}</table>'


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _box(content: str, name: str) -> str:
    """A part of the page that screen readers can go to by its name."""
    return f'<section class="{OURS}" aria-label="{name}" style="{_STYLE}">{content}</section>'


def said_html(*lines: str) -> str:
    """Short lines about what is shown, for people and for screen readers."""
    return _box(f'<div role="status">{"<br>".join(safe(line, 500) for line in lines)}</div>', "State")
