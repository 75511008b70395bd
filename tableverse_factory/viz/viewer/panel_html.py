"""HTML of the panel for the facts of a scene. Every text from the dataset is cut and escaped here."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

from tableverse_factory.core.text import sanitize_line
from tableverse_factory.viz.gallery.formatting import (
    DASH,
    explain_reason,
    format_camera,
    format_degrees,
    format_mass,
    format_millimetres,
    format_scale,
)

MAX_ROWS = 100  # most objects and tasks that are listed

_STYLE = "font-size:0.8rem;line-height:1.35;padding:0.25rem 0.75rem;overflow-wrap:anywhere"
_HEADING = "font-size:0.85rem;margin:0.7rem 0 0.2rem"
SECTION_CLASS = "tableverse"  # CSS class of our sections in the page of viser

_CERTIFICATE = (
    ("deepest overlap of pieces", "piece_penetration_m", format_millimetres),
    ("before settling", "piece_penetration_before_m", format_millimetres),
    ("deepest overlap of meshes", "mesh_penetration_m", format_millimetres),
    ("drift in 5 s", "drift_m", format_millimetres),
    ("turned in 5 s", "drift_rad", format_degrees),
)

Row = Mapping[str, Any]


def escape_text(value: object, limit: int = 120) -> str:
    """Cut a text to one line and escape it for HTML."""
    return escape(sanitize_line(str(value), limit), quote=True)


def format_photograph(jpeg: bytes | None) -> str:
    """Format the photograph."""
    if jpeg is None:
        return _format_section("<p>No photograph: this scene was made from a layout.</p>", "Photograph")
    data = base64.b64encode(jpeg).decode()
    picture = f'<img alt="The photograph that this scene was made from" src="data:image/jpeg;base64,{data}" '
    return _format_section(picture + 'style="width:100%;border-radius:4px;display:block">', "Photograph")


def format_dropped_scene(row: Row) -> str:
    """Format the reason why a scene was dropped or failed."""
    reason = str(row.get("reason") or row.get("error_kind") or "")
    lines = [
        f"<b>{escape_text(row.get('status'))}</b> at {escape_text(row.get('stage'))}: "
        f"{escape_text(reason.replace('_', ' '))}",
        escape_text(explain_reason(reason)),
        escape_text(row.get("detail") or "", 500),
    ]
    return _format_section(_format_title(row) + "".join(f"<p>{line}</p>" for line in lines if line), "Facts")


def format_facts(row: Row, meta: Row, objects: Sequence[Row], tasks: Sequence[Row], link: str) -> str:
    """Format certificate, objects with masses, and tasks; `row` and `link` are empty for a scene outside a dataset."""
    certificate = meta.get("certificate")
    figures = certificate if isinstance(certificate, Mapping) else row
    lines = [(name, write(_parse_number(figures.get(key)))) for name, key, write in _CERTIFICATE]
    kept = [(name, text) for name, text in lines if text != DASH]
    source = [(name, escape_text(row[name])) for name in ("source", "licence") if row.get(name)]
    metric = [("scale", escape_text(format_scale(row))), ("camera", escape_text(format_camera(row)))]
    source += [(name, text) for name, text in metric if text != DASH]
    score = [("quality", f"{escape_text(row['quality_score'])} of 10")] if row.get("quality_score") is not None else []
    parts = [
        _format_table("Certificate", kept),
        _format_table("Scene", [*score, *source]),
        _format_objects(objects),
        _format_tasks(tasks),
    ]
    if link:
        parts.append(f'<p><a href="{escape(link, quote=True)}">Link to this scene</a></p>')
    return _format_section(_format_title(row) + "".join(parts), "Facts")


def _format_title(row: Row) -> str:
    name = row.get("name") or row.get("scene_id") or "Scene"
    return f'<h1 style="font-size:1rem;margin:0.4rem 0">{escape_text(name, 80)}</h1>'


def _format_objects(rows: Sequence[Row]) -> str:
    lines = [
        (
            escape_text(row.get("relabel_name") or row.get("label") or row["object_id"], 60),
            format_mass(_parse_number(row.get("mass_kg"))),
        )
        for row in rows[:MAX_ROWS]
    ]
    return _format_table(f"Objects ({len(rows)})", lines)


def _format_tasks(rows: Sequence[Row]) -> str:
    accepted = [row for row in rows if row.get("accepted")]
    lines = "".join(f"<li>{escape_text(row.get('instruction') or '', 200)}</li>" for row in accepted[:MAX_ROWS])
    return f'<h2 style="{_HEADING}">Tasks ({len(accepted)})</h2><ol>{lines}</ol>' if accepted else ""


def _format_table(title: str, lines: Sequence[tuple[str, str]]) -> str:
    """Format a title and rows of names and values, which are HTML already."""
    if not lines:
        return ""
    rows = "".join(
        f'<tr><th scope="row" style="text-align:left;font-weight:400">{name}</th>'
        f'<td style="text-align:right">{text}</td></tr>'
        for name, text in lines
    )
    return f'<h2 style="{_HEADING}">{title}</h2><table style="width:100%">{rows}</table>'


def _parse_number(value: object) -> float | None:
    return float(value) if isinstance(value, int | float) and not isinstance(value, bool) else None


def _format_section(content: str, name: str) -> str:
    """Format a section that screen readers find by its name."""
    return f'<section class="{SECTION_CLASS}" aria-label="{name}" style="{_STYLE}">{content}</section>'


def format_status(*lines: str) -> str:
    """Format short lines about the state of the view, which screen readers announce."""
    return _format_section(f'<div role="status">{"<br>".join(escape_text(line, 500) for line in lines)}</div>', "State")
