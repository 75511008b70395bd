"""Dataset card, OUT/README.md: content of the dataset, where scenes were lost, and licences."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from schemas.outcome import ModelCost
from schemas.tables import SCENES
from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.card_yaml import make_front_matter
from tableverse_factory.dataset.committed_rows import read_shards
from tableverse_factory.dataset.judge_summary import JudgeSummary, summarize_judgements
from tableverse_factory.dataset.model_costs import read_model_costs
from tableverse_factory.dataset.trajectory_summary import TrajectorySummary, summarize_trajectories

_COLUMNS = (
    *("status", "stage", "reason", "error_kind", "source", "licence", "licence_verdict", "mesh_licences"),
    "perception",
)
_MAX_ROWS = 40
_EXAMPLE = """\
import pyarrow.compute as pc
from tableverse_factory import open_dataset

dataset = open_dataset("…")
done = dataset.scenes.to_table(columns=["scene_id"], filter=pc.field("status") == "done")
model = dataset.scene(done["scene_id"][0].as_py()).model()  # a mujoco.MjModel"""


def make_dataset_card(out: StoragePath, run: Mapping[str, Any], shards: Sequence[int]) -> str:
    """Make the card of these committed shards as Markdown with the Hub's front matter; `run` is `run.json`."""
    read = read_shards(out, "scenes", shards, _COLUMNS)
    scenes = pa.concat_tables([SCENES.empty_table().select(list(_COLUMNS)), *read])
    rows = {
        table: sum(found.num_rows for found in read_shards(out, table, shards, ["scene_id"]))
        for table in ("objects", "tasks")
    }
    status = Counter(scenes["status"].to_pylist())
    motions = summarize_trajectories(out, shards)
    bound = _select_done(scenes, "licence", "mesh_licences")
    licences = [name for row in bound for name in (row["licence"] or "", *(row["mesh_licences"] or ()))]
    tables = ["scenes", *(table for table in rows if rows[table]), *(["trajectories"] if motions.tasks else [])]
    parts = [
        make_front_matter(scenes.num_rows, licences, tables),
        "# Table-top scenes for MuJoCo",
        "Made by TableVerse Factory from pictures; every scene was settled, and certified on the exported XML.",
        _format_table(
            ("what", "count"),
            [
                ("scenes in the manifest", scenes.num_rows),
                *((outcome, status[outcome]) for outcome in ("done", "dropped", "failed")),
                *rows.items(),
                *([("trajectories that succeed in simulation", motions.succeeded)] if motions.tasks else []),
                ("shards", len(shards)),
            ],
        ),
        "## Where scenes were lost",
        _format_funnel(scenes),
        *_format_trajectories(motions),
        "## Licences",
        _format_licences(scenes),
        "## Sources",
        _format_sources(scenes),
        "## Models",
        _format_models(scenes, summarize_judgements(out, shards), read_model_costs(out, shards)),
        "## Reading it",
        f"```python\n{_EXAMPLE}\n```",
        "## How it was made",
        f"Seed {run['seed']}, configuration `{run['fingerprint'][:16]}`; `run.json` holds every value and version.",
    ]
    if "published" in run:  # by `tableverse export`
        profile = run["published"]["profile"]
        parts.append(f"Only scenes of the profile `{profile}` are in here; the others were left out.")
    return "\n\n".join(parts) + "\n"


def _format_funnel(scenes: pa.Table) -> str:
    lost = scenes.filter(pc.not_equal(scenes["status"], "done"))
    if not lost.num_rows:
        return "None was."
    whys = [row["reason"] or row["error_kind"] for row in lost.select(["reason", "error_kind"]).to_pylist()]
    counts = Counter(zip(lost["status"].to_pylist(), lost["stage"].to_pylist(), whys, strict=True))
    return _format_table(("status", "stage", "why", "scenes"), [(*key, count) for key, count in _sort_by_count(counts)])


def _format_trajectories(motions: TrajectorySummary) -> list[str]:
    if not motions.tasks:
        return []
    share = motions.succeeded / motions.tasks
    parts = ["## Trajectories", f"{motions.succeeded} of {motions.tasks} tasks that were tried succeed ({share:.0%})."]
    if motions.failed:
        failed = [(*key, count) for key, count in _sort_by_count(motions.failed)]
        parts.append(_format_table(("failed in", "why", "tasks"), failed))
    return parts


def _format_licences(scenes: pa.Table) -> str:
    """Count licences by verdict and by name.

    A scene is an adaptation of its picture, so the picture's licence binds it, and those of generated meshes.
    """
    done = _select_done(scenes, "licence_verdict", "licence", "mesh_licences")
    verdicts = Counter(row["licence_verdict"] or "unknown" for row in done)
    names = Counter((_name_licences(row), row["licence_verdict"] or "unknown") for row in done)
    by_verdict = _format_table(("verdict", "done scenes"), _sort_by_count(verdicts))
    named = [(*key, count) for key, count in _sort_by_count(names)]
    by_name = _format_table(("licence", "verdict", "done scenes"), named)
    note = "Sorted by name, not by a lawyer; `tableverse export` writes a dataset without what may not be passed on."
    return f"{by_verdict}\n\n{by_name}\n\n{note}"


def _name_licences(row: Mapping[str, Any]) -> str:
    meshes = row["mesh_licences"]
    return (row["licence"] or "not stated") + (f"; meshes: {', '.join(meshes)}" if meshes else "")


def _format_sources(scenes: pa.Table) -> str:
    sources = Counter(row["source"] or "not stated" for row in _select_done(scenes, "source"))
    return _format_table(("source", "done scenes"), _sort_by_count(sources))


def _format_models(scenes: pa.Table, verdicts: JudgeSummary, spent: Mapping[str, ModelCost]) -> str:
    found = Counter(row["perception"] or "none" for row in _select_done(scenes, "perception"))
    rows = [("perception", name, count) for name, count in _sort_by_count(found)]
    rows += [("judge", name, count) for name, count in _sort_by_count(verdicts.judges)]
    parts = [_format_table(("role", "model", "done scenes"), rows)]
    if spent:
        head = ("role", "calls", "input tokens", "output tokens", "USD")
        paid = [
            (asker, cost.calls, cost.input_tokens, cost.output_tokens, f"{cost.usd:.4g}" if cost.usd else "–")
            for asker, cost in spent.items()
        ]
        parts += ["Cost of their answers when first given:", _format_table(head, paid)]
    if (agreement := verdicts.agreement) is not None:
        parts.append(
            f"Agreement with the rules, over {agreement.scenes} scenes: same gate {agreement.usable_share:.0%}, "
            f"score {agreement.score_difference:+.1f}, same nouns {agreement.names_share:.0%}, "
            f"masses × {agreement.mass_ratio:.2f}, tasks shared {agreement.tasks_share:.0%}."
        )
    if verdicts.remarks:
        parts += [
            "Corrected or rejected answers:",
            _format_table(("remark", "times"), _sort_by_count(verdicts.remarks)),
        ]
    return "\n\n".join(parts)


def _select_done(scenes: pa.Table, *columns: str) -> list[dict[str, Any]]:
    return scenes.filter(pc.equal(scenes["status"], "done")).select(columns).to_pylist()


def _sort_by_count(counts: Mapping[Any, int]) -> list[tuple[Any, int]]:
    return sorted(counts.items(), key=lambda item: (-item[1], str(item[0])))[:_MAX_ROWS]


def _format_table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(_escape_cell(cell) for cell in line) + " |" for line in lines)


def _escape_cell(value: object) -> str:
    """Escape markup in licences and reasons, which are untrusted, on one line."""
    text = sanitize_line(str(value))
    return "".join("\\" + c if c in "|`*<>[]#\\" and text != "---" else c for c in text)
