"""Rows of a scene in every table: those that the scene determines, with what the build knows of it."""

from typing import Any

from schemas.work import SceneResult
from tableverse_factory.dataset.licences import scene_license
from tableverse_factory.dataset.model_costs import make_cost_columns
from tableverse_factory.dataset.parts import SceneRows
from tableverse_factory.dataset.splits import find_split

_OF_MANIFEST = ("name", "url", "source", "licence", "content_sha256", "known_length", "parent", "recipe")


def complete_rows(result: SceneResult, own: SceneRows | None, shard: int, place: tuple[int, int] | None) -> SceneRows:
    """Complete the rows of a scene.

    Args:
        result: Its result.
        own: Rows that the scene determines; None unless it is done.
        shard: Its shard.
        place: Offset and size of its members in the tar [bytes]; None unless it is done.
    """
    tables = own or {"scenes": [{}], "objects": [], "tasks": [], "trajectories": []}
    row, (scene,), (offset, size) = result.row, tables["scenes"], place or (None, None)
    family = row.family or row.scene_id
    scene = {
        **scene,
        **{name: getattr(row, name) or None for name in _OF_MANIFEST},
        **{name: getattr(result, name) or None for name in ("reason", "error_kind", "detail")},
        **{name: getattr(result, name) for name in ("status", "stage", "attempts")},
        "scene_id": row.scene_id,
        "kind": row.kind.value,
        "uri": row.uri,
        "family": family,
        "split": find_split(family),
        "licence_verdict": scene_license({"licence": row.licence, "mesh_licences": scene.get("mesh_licences")}).value,
        **make_cost_columns(result.costs),
        "shard": shard,
        "tar_offset": offset,
        "tar_size": size,
    }
    timings: list[dict[str, Any]] = [
        {"scene_id": row.scene_id, "stage": t.stage, "cpu_s": t.cpu_s, "wall_s": t.wall_s} for t in result.timings
    ]
    return {**tables, "scenes": [scene], "timings": timings}
