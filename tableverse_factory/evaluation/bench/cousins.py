"""Figures of a dataset of cousins: how many end as done, what they cost, and how far those of a family differ."""

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations, permutations
from typing import Any

import numpy as np

from schemas.config import ObserveConfig
from schemas.curation import Relation
from schemas.geometry import Vector3
from tableverse_factory.core.errors import InputError
from tableverse_factory.core.process_pool import parallel_map
from tableverse_factory.core.storage.files import parse_path
from tableverse_factory.dataset.committed_rows import read_columns
from tableverse_factory.dataset.dataset import open_dataset
from tableverse_factory.geometry.math.aabb import aabb
from tableverse_factory.geometry.mesh.meshes import place_mesh
from tableverse_factory.geometry.relations.relations import SIDES, compute_body_features, relation_holds
from tableverse_factory.stages.cousins.parent import read_parent

SAME_LAYOUT_M, SAME_RELATIONS = 0.01, 0.05
COMPARED = (*SIDES, Relation.NEXT_TO, Relation.ON, Relation.IN)

Fact = tuple[Relation, str, str]


@dataclass(frozen=True, slots=True)
class SceneFacts:
    """Where the things of a scene stand, and which relations hold between them, by their ids."""

    centers: Mapping[str, Vector3]
    facts: frozenset[Fact]


@dataclass(frozen=True, slots=True)
class FamilyScore:
    """How a parent's cousins differ from it and from one another; NaN where there are fewer than two scenes."""

    parent: str
    done: int
    of: int
    from_parent_m: float  # median layout distance to the parent [m]
    layout_m: float  # median layout distance of two cousins [m]
    least_layout_m: float  # that of the nearest two
    relations: float  # median share of relations in which two cousins differ
    alike: int  # pairs of cousins that differ by less than `SAME_LAYOUT_M` and `SAME_RELATIONS`


@dataclass(frozen=True, slots=True)
class CousinsScore:
    """Figures of all cousins of a dataset; CPU times are of one cousin, all stages together [s]."""

    done: int
    of: int
    lost: tuple[tuple[str, int], ...]  # reasons of drops and kinds of failures, with their number
    cpu_mean_s: float  # NaN, like the next three, while no cousin of a committed shard was timed
    cpu_median_s: float
    cpu_p95_s: float
    cpu_max_s: float
    changes: tuple[tuple[str, int], ...]  # kinds of changes, with the number of done cousins that have one
    families: tuple[FamilyScore, ...]


def measure_cousins(out: str, most: int | None, jobs: int) -> CousinsScore:
    """Measure a dataset of cousins; families are compared with their parents, at most `most` of them."""
    dataset = open_dataset(out)
    columns = ["scene_id", "uri", "parent", "status", "reason", "error_kind", "changes", "shard"]
    rows = [row for row in dataset.scenes.to_table(columns=columns).to_pylist() if row["parent"] is not None]
    if not rows:
        raise InputError(f"{out}: no scene has a parent: give the DEST of `tableverse cousins`", "no_scenes")
    by_parent: dict[tuple[str, str], list[Mapping[str, Any]]] = defaultdict(list)
    for row in rows:
        by_parent[row["uri"], row["parent"]].append(row)
    done = [row for row in rows if row["status"] == "done"]
    lost = Counter(row["reason"] or row["error_kind"] for row in rows if row["status"] != "done")
    kinds = Counter(kind for row in done for kind in {change.partition(":")[0] for change in row["changes"]})
    seconds = _sum_cpu(out, {row["shard"] for row in rows})
    compare = partial(_compare_family, out)
    families = tuple(parallel_map(compare, list(by_parent.items())[:most], jobs, "compares cousins"))
    return CousinsScore(
        done=len(done),
        of=len(rows),
        lost=tuple(lost.most_common()),
        cpu_mean_s=_reduce(np.mean, seconds),
        cpu_median_s=_reduce(np.median, seconds),
        cpu_p95_s=_reduce(partial(np.percentile, q=95.0), seconds),
        cpu_max_s=_reduce(np.max, seconds),
        changes=tuple(kinds.most_common()),
        families=families,
    )


def _sum_cpu(out: str, shards: set[int]) -> list[float]:
    table = read_columns(parse_path(out), "timings", sorted(shards), ["scene_id", "cpu_s"])
    total: Counter[str] = Counter()
    for row in table.to_pylist():
        total[row["scene_id"]] += row["cpu_s"]
    return list(total.values())


def _compare_family(out: str, family: tuple[tuple[str, str], Sequence[Mapping[str, Any]]]) -> FamilyScore:
    (uri, parent), rows = family
    ids = [row["scene_id"] for row in rows if row["status"] == "done"]
    first, cousins = _read_facts(uri, parent), [_read_facts(out, name) for name in ids]
    pairs = list(combinations(cousins, 2))
    apart = [measure_layout_distance(a, b) for a, b in pairs]
    other = [measure_relation_distance(a, b) for a, b in pairs]
    from_parent = [measure_layout_distance(first, its) for its in cousins]
    return FamilyScore(
        parent=parent,
        done=len(ids),
        of=len(rows),
        from_parent_m=_reduce(np.median, from_parent),
        layout_m=_reduce(np.median, apart),
        least_layout_m=_reduce(np.min, apart),
        relations=_reduce(np.median, other),
        alike=sum(a < SAME_LAYOUT_M and r < SAME_RELATIONS for a, r in zip(apart, other, strict=True)),
    )


def _reduce(function: Any, values: Sequence[float]) -> float:
    return float(function(values)) if values else float("nan")


def _read_facts(path: str, scene_id: str) -> SceneFacts:
    scene = read_parent(open_dataset(path).scene(scene_id), ObserveConfig())
    meshes = {item.object_id: place_mesh(item.mesh, item.pose) for item in scene.objects}
    bodies = {name: compute_body_features(mesh) for name, mesh in meshes.items()}
    return SceneFacts(
        {name: np.mean(aabb(mesh.vertices), axis=0) for name, mesh in meshes.items()},
        frozenset(
            (relation, x, y)
            for x, y in permutations(bodies, 2)
            for relation in COMPARED
            if relation_holds(relation, bodies[x], bodies[y])
        ),
    )


def measure_layout_distance(a: SceneFacts, b: SceneFacts) -> float:
    """Mean distance between the places of the things that both scenes have [m]; 0 without any."""
    both = sorted(a.centers.keys() & b.centers.keys())
    return float(np.mean([np.linalg.norm(a.centers[name] - b.centers[name]) for name in both])) if both else 0.0


def measure_relation_distance(a: SceneFacts, b: SceneFacts) -> float:
    """Share of the relations of either scene that the other does not have, 0 to 1 (Jaccard distance)."""
    union = a.facts | b.facts
    return 1.0 - len(a.facts & b.facts) / len(union) if union else 0.0
