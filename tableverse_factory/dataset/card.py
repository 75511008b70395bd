"""Dataset card, OUT/README.md: content of the dataset, where scenes were lost, and licences."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from schemas.outcome import ModelCost
from tableverse_factory.core.storage.files import StoragePath
from tableverse_factory.core.text import sanitize_line
from tableverse_factory.dataset.card_yaml import make_front_matter
from tableverse_factory.dataset.columns import count_groups
from tableverse_factory.dataset.committed_rows import count_rows, read_columns
from tableverse_factory.dataset.judge_summary import JUDGEMENT_COLUMNS, JudgeSummary, summarize_judgements
from tableverse_factory.dataset.model_costs import COST_COLUMNS, sum_model_costs
from tableverse_factory.dataset.trajectory_summary import TrajectorySummary, summarize_trajectories

_SCALES = ("scale_source", "intrinsics_source")
_ORIGINS = ("source", "licence", "licence_verdict", "mesh_licences", "perception", *_SCALES)
_LOSSES = ("status", "stage", "reason", "error_kind")
_COLUMNS = tuple(dict.fromkeys((*_ORIGINS, *_LOSSES, *JUDGEMENT_COLUMNS, *COST_COLUMNS)))
_MAX_ROWS = 40
_EXAMPLE = """\
import pyarrow.compute as pc
from tableverse_factory import open_dataset

dataset = open_dataset("…")
done = dataset.scenes.to_table(columns=["scene_id"], filter=pc.field("status") == "done")
model = dataset.scene(done["scene_id"][0].as_py()).model()  # a mujoco.MjModel"""


def make_dataset_card(out: StoragePath, run: Mapping[str, Any], shards: Sequence[int]) -> str:
    """Make the card of these committed shards as Markdown with the Hub's front matter; `run` is `run.json`."""
    scenes = read_columns(out, "scenes", shards, _COLUMNS)
    rows = {table: count_rows(out, table, shards) for table in ("objects", "tasks")}
    status = {outcome: count for (outcome,), count in count_groups(scenes, ["status"]).items()}
    motions = summarize_trajectories(out, shards)
    done = scenes.select(list(_ORIGINS)).filter(pc.equal(scenes["status"], "done"))
    licences = {name or "" for name in pc.unique(done["licence"]).to_pylist()}
    licences |= set(pc.unique(pc.list_flatten(done["mesh_licences"])).to_pylist())
    tables = ["scenes", *(table for table in rows if rows[table]), *(["trajectories"] if motions.tasks else [])]
    parts = [
        make_front_matter(scenes.num_rows, licences, tables),
        "# Table-top scenes for MuJoCo",
        _describe_certification(run),
        _format_table(
            ("what", "count"),
            [
                ("scenes in the manifest", scenes.num_rows),
                *((outcome, status.get(outcome, 0)) for outcome in ("done", "dropped", "failed")),
                *rows.items(),
                *([("trajectories that succeed in simulation", motions.succeeded)] if motions.tasks else []),
                ("shards", len(shards)),
            ],
        ),
        "## Where scenes were lost",
        _format_funnel(scenes),
        *_format_trajectories(motions),
        "## Licences",
        _format_licences(done),
        "## Sources",
        _format_sources(done),
        "## Scale",
        _format_scales(done),
        "## Models",
        _format_models(done, summarize_judgements(scenes), sum_model_costs(scenes)),
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
    lost = scenes.select(list(_LOSSES)).filter(pc.not_equal(scenes["status"], "done"))
    if not lost.num_rows:
        return "None was."
    counts = Counter[tuple[str, ...]]()
    for (status, stage, reason, kind), count in count_groups(lost, _LOSSES).items():
        counts[status, stage, reason or kind] += count
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


def _format_licences(done: pa.Table) -> str:
    """Count licences by verdict and by name.

    A scene is an adaptation of its picture, so the picture's licence binds it, and those of generated meshes.
    """
    verdicts, names = Counter[str](), Counter[tuple[str, str]]()
    licences = done.select(["licence", "licence_verdict"])
    licences = licences.append_column("meshes", pc.binary_join(done["mesh_licences"], ", "))
    for (licence, given, meshes), count in count_groups(licences, licences.column_names).items():
        verdict = given or "unknown"
        verdicts[verdict] += count
        names[(licence or "not stated") + (f"; meshes: {meshes}" if meshes else ""), verdict] += count
    by_verdict = _format_table(("verdict", "done scenes"), _sort_by_count(verdicts))
    named = [(*key, count) for key, count in _sort_by_count(names)]
    by_name = _format_table(("licence", "verdict", "done scenes"), named)
    note = "Sorted by name, not by a lawyer; `tableverse export` writes a dataset without what may not be passed on."
    return f"{by_verdict}\n\n{by_name}\n\n{note}"


def _format_sources(done: pa.Table) -> str:
    return _format_table(("source", "done scenes"), _count_values(done, "source", "not stated"))


def _format_scales(done: pa.Table) -> str:
    """Count scenes by where their metres and their camera come from (docs/formats.md)."""
    counts = Counter[tuple[str, ...]]()
    for values, count in count_groups(done, _SCALES).items():
        counts[tuple(value or "–" for value in values)] += count
    rows = [(*key, count) for key, count in _sort_by_count(counts)]
    return _format_table(("metres", "camera", "done scenes"), rows)


def _format_models(done: pa.Table, verdicts: JudgeSummary, spent: Mapping[str, ModelCost]) -> str:
    rows = [("perception", name, count) for name, count in _count_values(done, "perception", "none")]
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
            "Verdicts corrected by checks:",
            _format_table(("remark", "times"), _sort_by_count(verdicts.remarks)),
        ]
    return "\n\n".join(parts)


def _count_values(done: pa.Table, name: str, missing: str) -> list[tuple[Any, int]]:
    counts = Counter[str]()
    for (value,), count in count_groups(done, [name]).items():
        counts[value or missing] += count
    return _sort_by_count(counts)


def _sort_by_count(counts: Mapping[Any, int]) -> list[tuple[Any, int]]:
    return sorted(counts.items(), key=lambda item: (-item[1], str(item[0])))[:_MAX_ROWS]


def _describe_certification(run: Mapping[str, Any]) -> str:
    poses = run.get("config", {}).get("export", {}).get("poses", "settled")
    made = "Made by TableVerse Factory from pictures; "
    if poses != "settled":
        return f"{made}objects stand as they were {poses}: scenes may collide and move, as their certificates say."
    return (
        f"{made}every scene was settled, and certified on the exported XML. MuJoCo 3.2 and newer load the scenes; they "
        "rest as certified with 3.3.7 and newer."
    )


def _format_table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(_escape_cell(cell) for cell in line) + " |" for line in lines)


def _escape_cell(value: object) -> str:
    """Escape markup in licences and reasons, which are untrusted, on one line."""
    text = sanitize_line(str(value))
    return "".join("\\" + c if c in "|`*<>[]#\\" and text != "---" else c for c in text)
